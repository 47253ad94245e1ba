# make demo, demo-paper, demo-lit, demo-shirt, demo-dressed, drape, gpu, test, test-all, docs, lint,
# dist: each installs into .venv what it needs and is not there yet (seconds where nothing is
# missing), and runs.
# PYTHON=python3.12 takes another Python for a new .venv; TORCH=any takes torch with CUDA too.
# LLVM comes with it on Linux on x86-64; elsewhere every command says what to install.

PYTHON ?= python3
PY := .venv/bin/python
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c

# Extras of pyproject.toml; make demo needs none
EXTRAS_demo :=
EXTRAS_demo-paper := learn
EXTRAS_demo-dressed := learn
EXTRAS_drape := learn,usd
EXTRAS_test := test
EXTRAS_docs := docs
EXTRAS_lint := lint
EXTRAS_dist := dist

.PHONY: demo demo-paper demo-lit demo-shirt demo-dressed drape gpu test test-all docs lint dist clean
.PRECIOUS: .venv/with-%
.NOTPARALLEL:

demo: .venv/with-demo
	$(PY) -m polysft_mi demo -o out/demo --overwrite

# The same by the paper's own way: Adam on its losses, frames in windows of three; some minutes
demo-paper: .venv/with-demo-paper
	$(PY) -m polysft_mi.run scenes/demo.xml -D preset=paper -o out/demo-paper --overwrite

# A sheet whose light is in the rendering, by path replay; some minutes
demo-lit: .venv/with-demo
	$(PY) -m polysft_mi.run scenes/demo_lit.xml -o out/demo-lit --overwrite

demo-shirt: .venv/with-demo
	$(PY) -m polysft_mi.run scenes/demo_shirt.xml -o out/demo-shirt --overwrite

# A garment on a moving body, which OneFit knows; two or three minutes
demo-dressed: .venv/with-demo-dressed
	$(PY) -m polysft_mi.run scenes/demo_dressed.xml -o out/demo-dressed --overwrite

drape: .venv/with-drape
	$(PY) -m onefit.drape dress dance -o out/drape --seconds 2 --overwrite

# What runs on an NVIDIA GPU, and how fast; out/benchmarks/gpu/gpu.md has the result
gpu: .venv/with-test
	$(PY) benchmarks/gpu.py

# All but those that are marked as slow; test-all has these, too
test: .venv/with-test
	$(PY) -m pytest -q -n 2 --dist loadfile -m 'not slow'

test-all: .venv/with-test
	$(PY) -m pytest -q -n 2 --dist loadfile

# The pages of docs/ as HTML, in out/docs, with the API reference; a warning is an error
docs: .venv/with-docs
	$(PY) -m sphinx -W --keep-going -q -b html docs out/docs

lint: .venv/with-lint
	$(PY) -m ruff check
	$(PY) -m ruff format --check
	$(PY) -m mypy

# Source distribution and wheel, in dist; and whether the wheel works, in an environment that has
# nothing else and a folder that is empty
dist: .venv/with-dist
	rm -rf dist build out/installed
	$(PY) -m build -o dist >/dev/null
	$(PY) -m twine check --strict dist/*
	$(PY) -m venv --without-pip out/installed/venv
	$(PY) -m pip --python out/installed/venv/bin/python install -q --disable-pip-version-check \
	    -c constraints.txt dist/*.whl
	mkdir out/installed/empty
	cd out/installed/empty && ../venv/bin/polysft --version && ../venv/bin/polysft demo -q

.venv/with-%: pyproject.toml constraints.txt | $(PY)
	@$(if $(filter learn% test docs,$(EXTRAS_$*)),$(no_surprise))
	@printf 'installing for make $*, into .venv, a minute or so: '
	@PYTHONWARNINGS=ignore PYTHONUNBUFFERED=1 $(PY) -m pip install --progress-bar off \
	    --disable-pip-version-check -c constraints.txt -e '.$(if $(EXTRAS_$*),[$(EXTRAS_$*)])' \
	    | awk '/^Collecting/ { printf "." } /^Installing/ { printf " unpacking" } \
	        { fflush() } END { print "" }'
	@touch $@

# Debian keeps venv's own pip in a package of its own (python3-venv); without it the system's pip
# puts one into the environment.
$(PY):
	@if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then $(PYTHON) -m venv .venv; else \
	    $(PYTHON) -m venv --without-pip .venv && $(PYTHON) -m pip --python $(PY) install -q pip || \
	    { rm -rf .venv; echo 'error: no virtual environment can be made: install python3-venv' \
	        '(Debian, Ubuntu: apt-get install python3-venv)' >&2; exit 2; }; fi

# torch's default build for Linux needs several GB of CUDA libraries: not where no NVIDIA GPU is.
# pip says what it would install; nothing where torch is already there.
define no_surprise
if [ "$$TORCH" != any ] && [ ! -e /dev/nvidiactl ] && \
    $(PY) -m pip install -q --disable-pip-version-check --dry-run --no-deps --report - \
        -c constraints.txt torch 2>/dev/null | $(PY) -c $(find_cuda); then \
    echo 'error: pip would install torch with CUDA libraries of several GB, and here is no NVIDIA' \
        'GPU: set PIP_EXTRA_INDEX_URL to the index of the CPU builds (PyTorch'\''s "Get started"' \
        'page names it), or PIP_FIND_LINKS to the folder of a CPU wheel; TORCH=any takes it' \
        'nevertheless' >&2; exit 2; fi
endef
find_cuda := 'import json, sys; \
    found = json.load(sys.stdin)["install"]; \
    needs = [r for p in found for r in p["metadata"].get("requires_dist", [])]; \
    sys.exit(not any(r.startswith(("nvidia", "cuda")) for r in needs))'

clean:
	rm -rf .venv out build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
