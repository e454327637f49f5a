# The same words on a laptop and in CI. `make setup` needs Python 3.11 and no root.
#
#   make setup [PYTHON=...] [TORCH_INDEX_URL=...] [TORCH_CUDA=1]     the environment, in .venv
#   make demo                                                       serve a policy, evaluate it, show the table
#   make test                                                       lint, types, layers, tests
#   make families [FAMILIES="lerobot hf rcs libero openvla …"]                 tests of model families, in .venv-NAME each
#   make bench                                                      measure, and write the README's figures anew
#
# Torch comes from wherever pip looks (its settings, PIP_INDEX_URL, PIP_FIND_LINKS). TORCH_INDEX_URL names
# another index for torch alone: PyTorch's own install page gives the one with CPU-only wheels.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := setup
.PHONY: setup demo bench test families fmt lint type clean

VENV ?= .venv
TORCH ?= torch==2.13.0
TORCH_INDEX_URL ?=
TORCH_CUDA ?=
PYTHON ?= $(shell for python in python3.11 python3; do \
	$$python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null && command -v $$python && break; done)

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
CONSTRAINTS := $(VENV)/constraints.txt
STAMP := $(VENV)/.installed
# Environments of model families: requirements/NAME.txt, in $(VENV)-NAME. What is tested in each is in tests/families,
# in folders of the family's name. Those whose code is on no package index want its source, too: OPENPI_SRC, OPENVLA_SRC,
# OPENVLA_OFT_SRC, OCTO_SRC, DIFFUSION_POLICY_SRC, VJEPA2_SRC.
FAMILIES ?= lerobot hf rcs libero
TESTED_IN_hf := pi0 arro vjepa2_ac
TORCH_FROM := $(if $(TORCH_INDEX_URL),--index-url $(TORCH_INDEX_URL))

setup: $(STAMP)

demo: setup
	$(BIN)/vlagents-ray demo

# Some minutes; the other policy servers get an environment of their own, in .venv-peers.
bench: setup
	$(BIN)/vlagents-ray bench peers-setup
	$(BIN)/vlagents-ray bench report

test: lint type families
	@echo '== tests'
	VLAGENTS_RAY_ENVIRONMENTS=$(abspath $(VENV)) $(BIN)/pytest

families: $(FAMILIES:%=family-%)

family-%: $(VENV)-%/.installed
	@echo '== tests of $(or $(TESTED_IN_$*),$*), in $(VENV)-$*'
	$(VENV)-$*/bin/python -m pytest $(addprefix tests/families/,$(or $(TESTED_IN_$*),$*))

$(VENV)-%/.installed: requirements/%.txt requirements/testing.txt $(STAMP)
	$(BIN)/vlagents-ray env make $< $(addprefix --with ,requirements/testing.txt $(wildcard requirements/$*.testing.txt)) \
	  --into $(VENV)-$*
	@touch $@

fmt: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lint: setup
	@echo '== lint'
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@echo '== layers'
	$(BIN)/lint-imports

type: setup
	@echo '== types'
	$(BIN)/mypy

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find vlagents_ray tests -type d -name __pycache__ -prune -exec rm -rf {} +

# Installed once for each state of pyproject.toml, under the constraints of the torch that came first.
$(STAMP): pyproject.toml $(CONSTRAINTS)
	@echo '== installing vlagents-ray into $(VENV)'
	$(PIP) install --quiet --constraint $(CONSTRAINTS) --editable '.[dev]'
	$(PIP) check
	@touch $@

# Torch first and alone, so that no other package chooses its build; the constraints hold it (and Ray, which
# server and clients must share) for whatever is installed into this environment later, too.
$(CONSTRAINTS): pyproject.toml | $(BIN)/python
	@echo '== installing torch into $(VENV)'
	@plan=$$($(PIP) install --quiet --dry-run --report - $(TORCH_FROM) '$(TORCH)'); \
	if grep -qiE '"name": *"(nvidia|cuda)-' <<<"$$plan" && [ -z '$(TORCH_CUDA)' ] \
	    && ! [ -e /dev/nvidia0 ] && ! nvidia-smi >/dev/null 2>&1; then \
	  { echo 'setup: stopped before downloading several GB: pip would take the CUDA build of $(TORCH),'; \
	    echo '  but this machine shows no NVIDIA GPU (no /dev/nvidia0, no working nvidia-smi). Choose one:'; \
	    echo '    make setup TORCH_INDEX_URL=URL   an index with CPU-only wheels, as PyTorch'"'"'s install page gives'; \
	    echo '    PIP_FIND_LINKS=FOLDER make setup a folder that holds the CPU-only wheel'; \
	    echo '    make setup TORCH_CUDA=1          the CUDA build after all; it runs on a CPU, too'; } >&2; \
	  exit 1; \
	fi
	$(PIP) install --quiet $(TORCH_FROM) '$(TORCH)'
	@$(PIP) freeze | grep '^torch==' >$@
	@sed -n 's/.*"ray\[serve\]\(==[0-9.]*\)".*/ray\1/p' pyproject.toml >>$@
	@cat $@

$(BIN)/python:
	@[ -n '$(PYTHON)' ] || { echo 'setup: found no Python 3.11; install it, or name one: make setup PYTHON=/path/to/python3.11' >&2; exit 1; }
	'$(PYTHON)' -m venv $(VENV)
	$(PIP) install --quiet --upgrade 'pip>=24.3'  # older ones download all of torch only to plan
