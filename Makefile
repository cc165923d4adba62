# Everything that a newcomer needs: `make demo` and `make test`. Both set up what they use, once, in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := pyproject.toml $(shell find csrc -name '*.cpp' -o -name '*.h' -o -name CMakeLists.txt)

.PHONY: demo test quick test-slow test-browser mutants coverage sanitize sanitize-all sanitize-threads bench report lint docs wheel format
.PHONY: calibrate clean
.DELETE_ON_ERROR:

# The coefficients of the confidence of fit_pose (edgegrad/fit/pose/confidence.py), and how it does on other cases: an hour.
# MESHES are files of further objects.
CALIBRATION := out/calibration
ALIKE := --kinds lit covered plain shadow beside mask easy30 global global-mask --jobs 2 $(if $(MESHES),--meshes $(MESHES))
calibrate: $(VENV)/.ready
	$(BIN)/python -m benchmarks.poses $(ALIKE) --first 100 --count 22 --out $(CALIBRATION)/train.jsonl
	$(BIN)/python -m benchmarks.poses --train $(CALIBRATION)/train.jsonl
	$(BIN)/python -m benchmarks.poses $(ALIKE) --first 1000 --count 50 --out $(CALIBRATION)/test.jsonl
	$(BIN)/python -m benchmarks.poses --calibration $(CALIBRATION)/test.jsonl

demo: $(VENV)/.ready
	$(BIN)/edgegrad demo --runs 4 --out out/demo

# A worker for each processor, of one thread each (tests/conftest.py); a test may take so many seconds of processor time.
WORKERS := -n logical --maxprocesses 8 --dist worksteal
BUDGET := 30
# Failures are shown, and written to a file, as they come: an interrupted run leaves them.
test: $(VENV)/.ready
	$(BIN)/python -m pytest -m "not slow" $(WORKERS) --budget $(BUDGET) --failures=out/failures.txt

# Some tests of each layer, within a minute on two processors.
quick: $(VENV)/.ready
	$(BIN)/python -m pytest -q -m "quick and not slow" $(WORKERS) $(call marked,quick)

test-slow: $(VENV)/.ready
	$(BIN)/python -m pytest -m slow --timeout 3600 $(WORKERS) --failures=out/failures-slow.txt

# The live view in a real browser. Chromium is the system's; where it is missing, root gets it on Debian, and others are told.
test-browser: $(VENV)/.ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python selenium
	@command -v chromedriver >/dev/null || \
	  { [ "$$(id -u)" = 0 ] && apt-get update -qq && apt-get install -y -qq chromium chromium-driver; } >/dev/null 2>&1 || \
	  echo "make test-browser: skipped without Chromium and its chromedriver; on Debian: apt-get install chromium chromium-driver"
	$(BIN)/python -m pytest tests/live/test_browser.py

# What builds the kernel again in another way needs what pip would fetch for the build alone.
TOOLS := $(BIN)/uv pip install --quiet --python $(BIN)/python "cmake>=3.26" ninja "nanobind>=3.1"

# Whether tests notice a gradient of which one term is 5 % off.
mutants: $(VENV)/.ready
	$(TOOLS)
	$(BIN)/python tests/mutants.py

# Tests with a kernel in which AddressSanitizer and UndefinedBehaviorSanitizer watch every access and sum. Python itself is
# not built with them, so they are loaded before it; what it leaks at its end is not looked at.
SANITIZE := build/sanitize
# Files marked `watched` reach the lines of each source of the kernel, as `make coverage` checks, and are quick. Only files that
# have the marker are imported.
marked = $(sort $(shell grep -rlw "mark.$(1)" tests --include="test_*.py"))
CHOSEN = -m "watched and not slow and not unwatched" $(call marked,watched)
sanitize-all: CHOSEN = -m "not slow and not unsanitized"
PRELOAD := $(foreach name,asan ubsan stdc++,$(shell $(CXX) -print-file-name=lib$(name).so 2>/dev/null))
sanitize sanitize-all: $(VENV)/.ready
ifneq ($(words $(filter /%,$(PRELOAD))),3)
	@echo "make sanitize: skipped, for $(CXX) has no libasan.so and libubsan.so, which come with g++ on Linux"
else
	$(TOOLS)
	PATH=$(CURDIR)/$(BIN):$$PATH cmake -S csrc -B $(SANITIZE) -G Ninja -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG=-O1 \
	  -DCMAKE_CXX_COMPILER=$(CXX) -DEDGEGRAD_SANITIZE=address,undefined,float-cast-overflow \
	  -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python -Dnanobind_DIR=$$($(BIN)/python -m nanobind --cmake_dir)
	$(BIN)/ninja -C $(SANITIZE)
	EDGEGRAD_KERNEL=$(CURDIR)/$(SANITIZE)/_core.abi3.so LD_PRELOAD="$(PRELOAD)" \
	  ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1:detect_stack_use_after_return=1 \
	  UBSAN_OPTIONS=print_stacktrace=1:halt_on_error=1 \
	  $(BIN)/python -m pytest -n 2 --dist worksteal -p no:faulthandler $(CHOSEN)
endif

# What the tests of `make sanitize` reach of the kernel, by gcov.
coverage: $(VENV)/.ready
	$(TOOLS)
	$(BIN)/python tests/kernel_coverage.py

# The kernel without Python, from several threads, under ThreadSanitizer. First it must report a race that is there on
# purpose. Addresses are not randomised where this can be had: the sanitizer's own map has no room for all of them.
THREADS := build/threads
FIXED := $(shell setarch -R true 2>/dev/null && echo setarch -R)
sanitize-threads: $(VENV)/.ready
ifeq ($(filter /%,$(shell $(CXX) -print-file-name=libtsan.so 2>/dev/null)),)
	@echo "make sanitize-threads: skipped, for $(CXX) has no libtsan.so, which comes with g++ on Linux"
else
	rm -rf $(THREADS) && mkdir -p $(THREADS)
	printf '%s\n' $(filter-out csrc/python/% csrc/checks/faults.cpp,$(filter %.cpp,$(SOURCES))) | \
	  xargs -P 2 -I@ sh -c '$(CXX) -std=c++20 -O1 -g1 -pthread -fopenmp -fsanitize=thread -ffp-contract=off -w -Icsrc -c @ -o $(THREADS)/$$(echo @ | tr / _).o'
	$(CXX) -pthread -fopenmp -fsanitize=thread $(THREADS)/*.o -ldl -o $(THREADS)/threads
	embree=$$($(BIN)/python -c "from edgegrad.library import embree_path as path; print(path())") && \
	export TSAN_OPTIONS=ignore_noninstrumented_modules=1 && \
	$(FIXED) $(THREADS)/threads $$embree race 2>&1 | grep -q "WARNING: ThreadSanitizer: data race" && \
	echo "The race on purpose is reported." && $(FIXED) $(THREADS)/threads $$embree && echo "The kernel has none."
endif

bench: $(VENV)/.ready
	$(BIN)/python -m benchmarks.gradient_error
	$(BIN)/python -m benchmarks.speed --out out/speed.json

# The gradient's error against run time, with Mitsuba where it is installed, and in extreme cases: an hour each.
report: $(VENV)/.ready
	$(BIN)/python -m benchmarks.error_time
	$(BIN)/python -m benchmarks.stability

lint: $(VENV)/.ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[dev,demo,test]"
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright --pythonpath $(BIN)/python && $(BIN)/lint-imports
	$(BIN)/python tests/check_includes.py && $(BIN)/python tests/check_words.py
	$(BIN)/clang-format --dry-run --Werror $(filter-out %.txt %.toml,$(SOURCES))

# Warnings are errors; build/docs/index.html is the site.
docs: $(VENV)/.ready
	$(BIN)/uv pip install --quiet --python $(BIN)/python --group docs
	$(BIN)/python -m sphinx -b html -n -W --keep-going -q docs build/docs

# The wheel of this machine (Linux), in dist/: repaired, checked, and tried with every Python here and two torches each,
# for which uv fetches some 20 GB, once.
wheel: $(BIN)/uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --group wheel
	rm -rf build/wheel dist
	$(BIN)/uv build --quiet --wheel --out-dir build/wheel
	PATH=$(CURDIR)/$(BIN):$$PATH $(BIN)/auditwheel repair --exclude libgomp.so.1 --wheel-dir dist build/wheel/*.whl
	$(BIN)/abi3audit --strict dist/*.whl
	$(BIN)/twine check --strict dist/*.whl
	$(BIN)/python tests/clean_environments.py dist/*.whl

clean:
	rm -rf build dist out docs/notebooks $(VENV)

# uv (from PyPI) links packages from its cache instead of copying them.
$(BIN)/uv:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

# Editable: Python changes show at once; the kernel is built again when its sources are newer.
$(VENV)/.ready: $(SOURCES) | $(BIN)/uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python --editable ".[demo,test]"
	@touch $@
