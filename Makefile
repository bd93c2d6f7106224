# make demo   install, find a pump skid in a real scan of a plant room, say where the results lie
# make test   install, lint, check types and imports, run all tests
# make fast   formats, poses, features, rules and results: half a minute, in an environment that `make test` made
# make clean-kernels   after a change in a kernel that other kernels call: their caches do not notice it

PYTHON ?= python3.11
VENV ?= .venv
BIN := $(VENV)/bin
DEMO ?= demo
SOURCES := $(shell find src -name '*.py')
# An index out of bounds corrupts silently in compiled code: these run once with every access checked.
KERNEL_TESTS := $(wildcard $(foreach stage,near_surface isolate surface pairs surfels search verify refine scene,\
	tests/test_$(stage)*.py))

# What neither starts a child process for each model nor compiles the search.
QUICK_TESTS := $(foreach name,pose pairs config results imports deviation verify scans_ply scans_pcd scans_las scans_e57,\
	tests/test_$(name).py)

.PHONY: demo test fast lint clean clean-kernels

demo: $(VENV)/installed
	$(BIN)/scanfind find examples/pump/scan.e57 --model examples/pump/skid.ply --out $(DEMO) --overwrite
	@echo "demo: poses and points lie in $(abspath $(DEMO)); open $(DEMO)/points/*.ply in CloudCompare"

test: lint
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(VENV)/numba-checked $(BIN)/pytest -q $(KERNEL_TESTS)
	$(BIN)/pytest -m "slow or not slow"

fast: $(VENV)/developed
	$(BIN)/pytest -q $(QUICK_TESTS)

lint: $(VENV)/developed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# The developers' install is editable and so never out of date; where it is there, users' work is done with it.
$(VENV)/installed: pyproject.toml $(SOURCES) | $(BIN)/python
	test -f $(VENV)/developed || $(BIN)/pip install --quiet .
	touch $@

$(VENV)/developed: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

clean-kernels:
	rm -f src/scanfind/kernels/__pycache__/*.nb? $(VENV)/numba-checked/*/*.nb?

clean: clean-kernels
	rm -rf $(VENV) $(DEMO) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
