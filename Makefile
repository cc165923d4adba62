# Everything that a newcomer needs: `make demo` and `make test`. Both set up what they use, once, in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := pyproject.toml $(shell find csrc -name '*.cpp' -o -name '*.h' -o -name CMakeLists.txt)

# Threads that wait should not spin: see edgegrad/__init__.py.
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test test-slow bench lint format clean
.DELETE_ON_ERROR:

demo: $(VENV)/.ready
	$(BIN)/edgegrad demo --out out/demo

test: $(VENV)/.ready
	$(BIN)/python -m pytest -m "not slow"

test-slow: $(VENV)/.ready
	$(BIN)/python -m pytest -m slow

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
