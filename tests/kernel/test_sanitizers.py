"""`make sanitize` tests the kernel that it built, and the sanitizers report faults there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from edgegrad.library import core

KERNEL = os.environ.get("EDGEGRAD_KERNEL", "")
pytestmark = [pytest.mark.watched, pytest.mark.skipif(not KERNEL, reason="run by `make sanitize`")]

FAULTS = {
    "read_beyond(c_long(100))": "AddressSanitizer: heap-buffer-overflow",
    "read_freed(c_long(100))": "AddressSanitizer: heap-use-after-free",
    "overflow(c_int(2**30))": "signed integer overflow",
    "cast(c_double(1e10))": "is outside the range of representable values",
}


def test_the_kernel_is_the_one_with_sanitizers():
    assert core.__file__ == KERNEL
    code = Path(KERNEL).read_bytes()
    assert b"__asan_report_store8" in code and b"__ubsan_handle_add_overflow" in code


@pytest.mark.parametrize("call", FAULTS)
def test_faults_are_reported(call):
    """They end the process, with a message that names the place."""
    library = Path(KERNEL).with_name("libfaults.so")
    program = f"from ctypes import *; CDLL({str(library)!r}).{call}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode != 0
    assert FAULTS[call] in done.stderr and "faults.cpp" in done.stderr
