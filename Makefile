# make demo   install, find a pump skid in a real scan of a plant room, say where the results lie
# make test   install, lint, check types and imports, run all tests
# make fast   formats, poses, features, rules and results: half a minute, in an environment that `make test` made
# make paper  the paper's tables on scanfind, its preset sharif2017 and the rivals installed: hours, goes on where it stopped
# make paper-quick   one scene a row, a few rows of sharif2017: minutes; its page lies in $(QUICK)
# make recognition   the lines of recognition, some scenes each: an hour, goes on where it stopped
# make page   docs/benchmarks.md and its plots from benchmarks/results
# make clean-kernels   after a change in a kernel that other kernels call: their caches do not notice it

PYTHON ?= python3.11
VENV ?= .venv
BIN := $(VENV)/bin
DEMO ?= demo
SEEDS ?= 5000-5019
LINE_SEEDS ?= 7400-7411
QUICK ?= paper-quick
SOURCES := $(shell find src -name '*.py')
# An index out of bounds corrupts silently in compiled code: these run once with every access checked.
KERNEL_TESTS := $(wildcard $(foreach stage,near_surface isolate surface pairs surfels pool search verify refine scene onto_itself,\
	tests/test_$(stage)*.py))

# What neither starts a child process for each model nor compiles the search.
QUICK_TESTS := $(foreach name,pose pairs config results imports deviation verify scans_ply scans_pcd scans_las scans_e57,\
	tests/test_$(name).py)

.PHONY: demo test checked fast lint paper paper-quick recognition page clean clean-kernels

demo: $(VENV)/installed
	$(BIN)/scanfind find examples/pump/scan.e57 --model examples/pump/skid.ply --out $(DEMO) --overwrite
	@echo "demo: poses and points lie in $(abspath $(DEMO)); open $(DEMO)/points/*.ply in CloudCompare"

# mypy and the compiler each keep one core busy, so they go side by side; then tests themselves do, where a worker that
# has no tests left takes over some of another's.
test: $(VENV)/developed
	$(MAKE) -j2 lint checked
	$(BIN)/pytest -m "slow or not slow" -n auto --maxprocesses 4 --dist worksteal

checked: $(VENV)/developed
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(VENV)/numba-checked $(BIN)/pytest -q $(KERNEL_TESTS)

fast: $(VENV)/developed
	$(BIN)/pytest -q $(QUICK_TESTS)

lint: $(VENV)/developed
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

paper: $(VENV)/benched
	$(BIN)/python -m benchmarks.paper --seeds $(SEEDS) --experiments density,clutter,completeness
	$(BIN)/python -m benchmarks.paper --seeds $(SEEDS) --experiments effectiveness --system scanfind,sharif2017
	$(BIN)/python -m benchmarks.paper --seeds $(SEEDS) --experiments branch --system scanfind
	$(BIN)/python -m benchmarks.page

# The preset takes all of its 20 s a scene: only the rows the paper calls typical.
paper-quick: $(VENV)/benched
	$(BIN)/python -m benchmarks.paper --seeds 0 --system scanfind --out $(QUICK)
	$(BIN)/python -m benchmarks.paper --seeds 0 --system sharif2017 --rows 10,51.295,20.794,0.822,0.917 --out $(QUICK)
	$(BIN)/python -m benchmarks.page --results $(QUICK) --docs $(QUICK) --pictures 0
	@echo "paper-quick: the tables lie in $(abspath $(QUICK))/benchmarks.md"

recognition: $(VENV)/benched
	$(BIN)/python -m benchmarks.recognition --seeds $(LINE_SEEDS)
	$(BIN)/python -m benchmarks.page

page: $(VENV)/benched
	$(BIN)/python -m benchmarks.page

# The developers' install is editable and so never out of date; where it is there, users' work is done with it.
$(VENV)/installed: pyproject.toml $(SOURCES) | $(BIN)/python
	test -f $(VENV)/developed || $(BIN)/pip install --quiet .
	touch $@

$(VENV)/developed: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@

$(VENV)/benched: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --editable '.[bench]'
	touch $@

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

clean-kernels:
	rm -f src/scanfind/kernels/__pycache__/*.nb? $(VENV)/numba-checked/*/*.nb?

clean: clean-kernels
	rm -rf $(VENV) $(DEMO) $(QUICK) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
