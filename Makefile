# Everything that a newcomer needs: `make demo` and `make test`. Both set up what they use, once, in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := pyproject.toml $(shell find csrc -name '*.cpp' -o -name '*.h' -o -name CMakeLists.txt)

# Threads that wait should not spin: see edgegrad/__init__.py.
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test test-slow sanitize bench lint format clean
.DELETE_ON_ERROR:

demo: $(VENV)/.ready
	$(BIN)/edgegrad demo --out out/demo

test: $(VENV)/.ready
	$(BIN)/python -m pytest -m "not slow"

test-slow: $(VENV)/.ready
	$(BIN)/python -m pytest -m slow

# The tests of the kernel, with a kernel in which AddressSanitizer and UndefinedBehaviorSanitizer watch every access and
# sum. Python itself is not built with them, so they are loaded before it; what it leaks at its end is not looked at.
SANITIZE := build/sanitize
sanitize: $(VENV)/.ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python "cmake>=3.26" ninja nanobind
	PATH=$(CURDIR)/$(BIN):$$PATH cmake -S csrc -B $(SANITIZE) -G Ninja -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG=-O1 \
	  -DEDGEGRAD_SANITIZE=address,undefined -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python \
	  -Dnanobind_DIR=$$($(BIN)/python -m nanobind --cmake_dir)
	$(BIN)/ninja -C $(SANITIZE)
	EDGEGRAD_KERNEL=$(CURDIR)/$(SANITIZE)/_core.abi3.so \
	  LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libubsan.so) $$($(CXX) -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1 UBSAN_OPTIONS=print_stacktrace=1:halt_on_error=1 \
	  $(BIN)/python -m pytest -m "not slow" -n 2 -p no:faulthandler tests/test_pieces.py tests/test_pitfalls.py tests/test_coincident.py \
	  tests/test_shading.py tests/test_estimators.py tests/test_plan.py tests/test_messages.py tests/test_torch.py

bench: $(VENV)/.ready
	$(BIN)/python benchmarks/gradient_error.py
	$(BIN)/python benchmarks/speed.py --out out/speed.json

lint: $(VENV)/.ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[dev,demo,test]"
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright
	$(BIN)/clang-format --dry-run --Werror $(filter-out %.txt %.toml,$(SOURCES))

clean:
	rm -rf build out $(VENV)

# uv (from PyPI) links packages from its cache instead of copying them.
$(BIN)/uv:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

# Editable: Python changes show at once; the kernel is built again when its sources are newer.
$(VENV)/.ready: $(SOURCES) | $(BIN)/uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[demo,test]"
	@touch $@
