"""Whether a wheel works where nothing else is installed: python tests/clean_environments.py dist/*.whl

For each Python from 3.10 on that is found here, an environment with the oldest torch that it may have, and one with the newest:
`edgegrad doctor` and smoke.py run in them. Needs uv, and for each torch some gigabytes in uv's cache.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SMOKE = Path(__file__).with_name("smoke.py")
UV = shutil.which("uv", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])) or "uv"
OLDEST = "torch>=2.4"


def pythons() -> list[Path]:
    """One of each minor version: those on the path, and pyenv's."""
    folders = [Path(folder) for folder in os.environ.get("PATH", "").split(os.pathsep)]
    folders += sorted(Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob("versions/*/bin"))
    found: dict[int, Path] = {}
    for path in (path for folder in folders for path in sorted(folder.glob("python3.*"))):
        minor = re.fullmatch(r"python3\.(\d+)", path.name)
        if minor and int(minor[1]) >= 10 and int(minor[1]) not in found and works(path):
            found[int(minor[1])] = path
    return [path for _, path in sorted(found.items())]


def works(python: Path) -> bool:
    """A shim of pyenv may stand for a version that is not switched on."""
    return subprocess.run([python, "-c", "import venv"], capture_output=True, cwd="/").returncode == 0


def run(*command: str | Path, **options: object) -> str:
    done = subprocess.run([str(part) for part in command], text=True, capture_output=True, **options)  # pyright: ignore
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def check(wheel: Path, python: Path, resolution: str) -> str:
    """What was tried, as a line."""
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "EDGEGRAD_KERNEL")}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "env"
        run(UV, "venv", "--quiet", "--python", python, home)
        own = home / "bin" / "python"
        run(UV, "pip", "install", "--quiet", "--python", own, "--resolution", resolution, wheel, OLDEST)
        run(home / "bin" / "edgegrad", "doctor", cwd=folder, env=clean)
        run(own, SMOKE, cwd=folder, env=clean)
        ask = "import platform, torch, numpy; print(platform.python_version(), torch.__version__, numpy.__version__)"
        version, torch, numpy = run(own, "-c", ask, cwd=folder, env=clean).split()
    return f"Python {version:8} torch {torch:14} numpy {numpy:8} right"


def main(wheel: Path) -> None:
    for python in pythons():
        for resolution in ("lowest-direct", "highest"):
            print(check(wheel, python, resolution), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
