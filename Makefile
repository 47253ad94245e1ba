# make demo, make drape, make test, make docs: each installs what is missing into .venv (seconds where nothing is) and runs.
# PYTHON=python3.12 takes another Python for a new .venv.

PYTHON ?= python3
PY := .venv/bin/python
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
INSTALLED := .venv/installed

.PHONY: demo drape test docs venv llvm clean

demo: venv
	$(PY) -m polysft_mi.run scenes/demo.xml -o out/demo --overwrite

drape: venv
	$(PY) -m onefit.drape dress dance --weights dress -o out/drape --seconds 2 --overwrite

test: venv
	$(PY) -m pytest -q

# The pages of docs/ as HTML, in out/docs; a warning is an error
docs: $(INSTALLED)
	$(PY) -m sphinx -W --keep-going -q -b html docs out/docs

venv: $(INSTALLED) llvm

# Debian keeps venv's own pip in a package of its own (python3-venv); without it the system's pip puts one into the environment.
$(INSTALLED): pyproject.toml constraints.txt
	@if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then $(PYTHON) -m venv .venv; else \
	    $(PYTHON) -m venv --without-pip .venv && $(PYTHON) -m pip --python $(PY) install -q pip || \
	    { rm -rf .venv; echo 'error: no virtual environment can be made: install python3-venv (Debian, Ubuntu: apt-get install python3-venv)' >&2; exit 2; }; fi
	@printf 'installing into .venv, a minute or so, more where the network is slow: '
	@PYTHONWARNINGS=ignore PYTHONUNBUFFERED=1 $(PY) -m pip install --progress-bar off --disable-pip-version-check -c constraints.txt -e '.[test,docs]' \
	    | awk '/^Collecting/ { printf "."; fflush() } /^Installing/ { printf " unpacking"; fflush() } END { print "" }'
	@touch $@

# Rendering on the CPU needs a libLLVM, which no Python package brings.
llvm: $(INSTALLED)
	@$(PY) -m polysft_mi.backend >/dev/null 2>&1 || { $(install_llvm); $(PY) -m polysft_mi.backend; }

# 19 first, for it is tested most. Does nothing where apt-get is not there or may not be used: the line above then says what to install.
define install_llvm
if [ -z "$$DRJIT_LIBLLVM_PATH" ] && command -v apt-get >/dev/null; then \
    if [ "$$(id -u)" = 0 ]; then as_root='env DEBIAN_FRONTEND=noninteractive'; \
    elif sudo -n true 2>/dev/null; then as_root='sudo -n env DEBIAN_FRONTEND=noninteractive'; else as_root=; fi; \
    if [ -n "$$as_root" ]; then \
        echo 'installing libLLVM with apt-get'; $$as_root apt-get update -qq; \
        for version in 19 20 18 17; do \
            $$as_root apt-get install -qq -y --no-install-recommends -o DPkg::Lock::Timeout=300 libllvm$$version >/dev/null && break; \
        done; \
    fi; \
fi
endef

clean:
	rm -rf .venv out build *.egg-info .pytest_cache
