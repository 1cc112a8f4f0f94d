# Everything happens in .venv, so nothing outside this folder changes. CI calls these targets and no others.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TORCH ?= torch==2.13.0
WHEEL_VENV := build/wheel-venv

.PHONY: install check test test-slow wheel test-wheel sanitize bench bench-bake recipe-table paper-table space-table ground-truth textures pictures clean

install: $(VENV)/installed

# torch first and by exact version: a bare "torch" may bring gigabytes of CUDA libraries along.
$(VENV)/installed: pyproject.toml $(wildcard runtime/native/*)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(TORCH)
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

# Type checkers cannot follow the editable import hook: they look at a tree of links instead.
check: install
	mkdir -p build/typing/solidgrain
	for part in train export runtime bake; do ln -sfn ../../../$$part build/typing/solidgrain/$$part; done
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

test: install
	$(BIN)/python -m pytest -m 'not slow'

test-slow: install
	$(BIN)/python -m pytest

wheel: install
	rm -rf dist build/lib build/bdist.*
	$(BIN)/python -m build --wheel --outdir dist .

# The built wheel in an environment of its own, without torch: what a pipeline installs.
test-wheel: wheel
	rm -rf $(WHEEL_VENV)
	$(PYTHON) -m venv $(WHEEL_VENV)
	$(WHEEL_VENV)/bin/python -m pip install --quiet "$$(ls dist/*.whl)[test]"
	! $(WHEEL_VENV)/bin/python -c 'import torch' 2>/dev/null
	$(WHEEL_VENV)/bin/python -m pytest -m 'not slow' tests/runtime tests/bake

# The fused kernel under the address and undefined-behaviour sanitizers: its tests, every path that this machine has.
SANITIZED := build/sanitized/_kernel.so
sanitize: install
	mkdir -p $(dir $(SANITIZED))
	$(CXX) -std=c++17 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer \
		-ffp-contract=off -fPIC -shared -Wno-psabi runtime/native/*.cpp -o $(SANITIZED)
	LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libubsan.so)" ASAN_OPTIONS=detect_leaks=0 \
		SOLIDGRAIN_KERNEL_LIBRARY=$(SANITIZED) \
		$(BIN)/python -m pytest tests/runtime/test_kernel.py -k 'not damaged_library and not interrupt and not come_and_go'

bench: install
	$(BIN)/python -m tests.bench.bench $(FLAGS)

bench-bake: install
	$(BIN)/python -m tests.bench.bakes --large $(FLAGS)

# Hours unattended, and again after a kill: finished cells are kept (docs/experiments.md says how long they take).
MINUTES ?= 20
paper-table: install
	$(BIN)/python -m tests.bench.paper_table --minutes $(MINUTES) --resume $(FLAGS)

# What each switch of the recipe is worth, or with FLAGS="--only fast --exemplar PHOTO --largest 2048 --marks 5,15,30,60" its figures.
recipe-table: install
	$(BIN)/python -m tests.bench.recipe --resume $(FLAGS)

# A texture space on the photographs that it was never shown. FLAGS=--only-unadapted is the quicker half, FLAGS=--large all of it.
BUNDLE ?= stone
SECONDS ?= 60
space-table: install
	$(BIN)/python -m tests.bench.space_table --bundle $(BUNDLE) --seconds $(SECONDS) --resume $(FLAGS)

ground-truth: install
	$(BIN)/python -m tests.bench.ground_truth --minutes $(MINUTES) --resume $(FLAGS)

# Figures and pictures of the embedded textures. FLAGS="--only granite" measures one of them, FLAGS=--resume those that are new.
textures: install
	$(BIN)/python -m docs.textures $(FLAGS)

pictures: install
	$(BIN)/python -m docs.pictures $(FLAGS)

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache *.egg-info
