# Everything runs in .venv, made on first use; `make test PYTHON=python3` runs in an environment of your own.
# PIP_FLAGS='--extra-index-url https://download.pytorch.org/whl/cpu' gets the small torch, without CUDA.
PYTHON ?= .venv/bin/python
PIP_FLAGS ?=
# EXTRAS=dev,capture gets pycolmap (134 MB) too, without which the tests of posing photos are skipped.
EXTRAS ?= dev
VENV := $(filter .venv/bin/python,$(PYTHON))

# What `make fuzz` does: mutated packs, captures and meshes against every reader and whole commands, and kills of every
# writer at random moments.
PACKS ?= 10000
RUNS ?= 1000
FOREIGN ?= 2000
KILLS ?= 200
SEED ?= 0

SLOW ?=
ORDER ?=
SHARE ?= 1
MITSUBA ?=

.PHONY: help demo test test-order test-slow fuzz docs lint bench bench-paper bench-real bench-splats bench-table1 stability clean
.DEFAULT_GOAL := help

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 14

demo: $(VENV)  ## two small scenes, fused and rendered
	$(PYTHON) examples/demo.py

# One process per core, and one thread in each: most of the time goes to compiling, which runs on one core.
test: export NUMBA_NUM_THREADS = 1
test: export OMP_NUM_THREADS = 1
test: $(VENV)  ## the quick tests
	$(PYTHON) -m pytest -q -m 'not slow' -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

test-order: export NUMBA_NUM_THREADS = 1
test-order: export OMP_NUM_THREADS = 1
test-order: $(VENV)  ## the quick tests in random order, which is said and can be repeated: ORDER=--random-order-seed=N
	$(PYTHON) -m pytest -q -m 'not slow' -n auto --maxprocesses 4 --dist loadfile --random-order $(ORDER)

test-slow: $(VENV)  ## the slow tests, two files at a time, and how long each takes; SLOW=--third: a third of them
	$(PYTHON) -m tests.slow $(SLOW)

fuzz: $(VENV)  ## 10,000 hostile packs, captures and meshes, 1,000 by whole commands, 2,000 checkpoints of every other system and files of splats of each format, and 200 kills of every command; PACKS=, RUNS=, FOREIGN=, KILLS=, SEED=
	$(PYTHON) -m tests.promises.fuzz --count $(PACKS) --seed $(SEED)
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(PYTHON) -m tests.promises.commands --count $(RUNS) --seed $(SEED)
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(PYTHON) -m tests.promises.fuzz_inputs --readers $(PACKS) --foreign $(FOREIGN) --commands $(RUNS) --seed $(SEED)
	$(PYTHON) -m tests.promises.kills --kills $(KILLS) --seed $(SEED) --calls --adds 16

docs: $(VENV)  ## docs/commands.md, out of --help
	$(PYTHON) -m docs.commands

lint: $(VENV)  ## ruff, rules and format
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .

bench: $(VENV)  ## the measurements that the claims rest on; DATA= a folder with bear/, chair/ and fuze/: full frames too
	$(PYTHON) -m benchmarks
	$(if $(DATA),$(PYTHON) -m benchmarks.filled $(DATA))

bench-paper: $(VENV)  ## the paper's experiments: docs/paper; DATA= a folder with chair/ and fuze/
	$(PYTHON) -m benchmarks.paper $(if $(DATA),--data $(DATA))

bench-real: $(VENV)  ## real captures: docs/real; DATA= a folder of captures, SHARE= for less time
	$(PYTHON) -m benchmarks.real $(DATA) --share $(SHARE)
	$(PYTHON) -m benchmarks.placed $(DATA) --share $(SHARE)
	$(PYTHON) -m benchmarks.extraction $(DATA) --share $(SHARE)

bench-splats: $(VENV)  ## splats as fields, alone and among other systems' fields on a park; DATA= a folder with splats/, bear/ and foreign/, MITSUBA= a Python that has Mitsuba
	$(PYTHON) -m benchmarks.splats $(DATA) $(if $(MITSUBA),--mitsuba $(MITSUBA))

bench-table1: $(VENV)  ## every kind on the same scenes: docs/table1.md; DATA= a folder with chair/, fox/, bear/ and fuze/, SHARE= for less time
	$(PYTHON) -m benchmarks.table1 $(DATA) --share $(SHARE)

stability: $(VENV)  ## the failure suite at length: docs/stability.md and its chart
	mkdir -p build
	rm -f build/stability.jsonl
	-$(PYTHON) -m pytest -q tests/failures --stability-report build/stability.jsonl
	$(PYTHON) -m benchmarks.stability build/stability.jsonl docs

clean:  ## all that can be made again
	rm -rf .venv build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/bin/python: .venv/.stamp ;

.venv/.stamp: pyproject.toml constraints.txt
	$$(command -v python3.11 || command -v python3) -m venv .venv
	.venv/bin/python -m pip install -q $(PIP_FLAGS) -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@
