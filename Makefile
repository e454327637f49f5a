# The same words on a laptop and in CI. `make setup` needs Python 3.11 and no root.
#
#   make setup [PYTHON=...] [TORCH_INDEX_URL=...] [TORCH_CUDA=1] [PLUGINS="sims …"]     the environment, in .venv
#   make demo                                                       serve a policy, evaluate it, show the table
#   make check                                                      lint, types, layers, quick tests: no Ray, torch, simulator
#   make test [TEST_PROCESSES=3]                                    lint, types, layers, all tests but integrations
#   make integrations [TEST_PROCESSES=3]                            families, and tests of other systems and of endurance
#   make families [FAMILIES="lerobot lerobot06 hf rcs libero libero_pro …"]    tests of model families, in .venv-NAME each
#   make verified [FAMILIES="lerobot hf"]                           what they verify, into verified.json beside these tests
#   make rays, make pythons                                         serve, act and evaluate once with other versions of Ray and Python
#   make programs                                                   those that others wrote, into tests/programs.json
#   make docs                                                       the site of docs/, in build/docs, for a browser
#   make extras [ONLY="record sim"]                                 resolve extras, into tests/extras.json
#   make locks [ONLY=family-hf]                                     resolve the images' packages, into cluster/docker/locks
#   make dist                                                       what a release publishes, checked, in dist
#   make release [UPLOAD=1]                                         check, build and tag a version; the tag publishes it
#   make sbom [LOCK=server-sim]                                     what an image installs and its licences, in build/sbom
#   make bench                                                      measure this server and others, into build/bench
#   make gpu [RUN=acts] [DRY=1] [GPU_PYTHON=python3] [STEPS="facts,tests"]     all that needs a GPU, in two runs of seven
#                                                                   minutes, acts and serving, into build/gpu
#   make gpu-pack                                                   what `make gpu` needs where there is no network
#
# Torch comes from wherever pip looks (its settings, PIP_INDEX_URL, PIP_FIND_LINKS). If that is a CUDA build and the machine
# shows no NVIDIA GPU, uv installs the CPU build from PyTorch's own index. TORCH_INDEX_URL names another index for torch.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := setup
.PHONY: setup demo reference bench gpu gpu-pack check quick collected test played integrations environments families docs verified programs rays pythons extras locks dist release sbom fmt lint type clean

VENV ?= .venv
TORCH ?= torch==2.13.0
# Those of plugins/vlagents_ray_NAME that `make setup` installs beside the core.
PLUGINS ?= arro cluster dialects learn live models results robot sims
TORCH_INDEX_URL ?=
TORCH_CUDA ?=
PYTHON ?= $(shell for python in python3.11 python3; do \
	$$python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null && command -v $$python && break; done)

GOAL := $(or $(MAKECMDGOALS),setup)
NO_PYTHON := $(GOAL): found no Python 3.11; install it, or name one: make $(GOAL) PYTHON=/path/to/python3.11

# Tests start hundreds of interpreters, and pytest rewrites every test file: without compiled files that is half of the time.
unexport PYTHONDONTWRITEBYTECODE
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
CONSTRAINTS := $(VENV)/constraints.txt
STAMP := $(VENV)/.installed
PROJECTS := pyproject.toml $(PLUGINS:%=plugins/vlagents_ray_%/pyproject.toml)
# `make check`, `docs`, `lint`, `type` and `fmt` do with a smaller environment where the whole one is not installed.
TOOLS := $(if $(wildcard $(STAMP)),$(VENV),$(VENV)-check)
# On two cores: tests wait for a third of their time, those of `make check` for half of it.
TEST_PROCESSES ?= 3
CHECK_PROCESSES ?= 4
# Marked so: what wants more than Python, takes more than a second, or wants the machine for itself (pyproject.toml,
# tests/support/needs.py).
NOT_QUICK := ray or server or hosts or sim or vulkan or torch or gpu or browser or compiler or alone or slow or integration
# Environments of model families and simulators, in $(VENV)-NAME: NAME.txt in requirements/ of a plug-in, or of tests/. What is
# tested in each is in the folders families/NAME of the plug-ins' tests. Those whose code is on no package
# index want its source, too: OPENPI_SRC, OPENVLA_SRC,
# OPENVLA_OFT_SRC, OCTO_SRC, DIFFUSION_POLICY_SRC, VJEPA2_SRC, GR00T_SRC.
# ros is a ROS 2 of its own; it wants Python 3.11.
# lerobot06 wants Python 3.12, and TORCH_CUDA=1 where no index has a torch without CUDA for it: several GB.
# calvin wants CALVIN_SRC, a checkout.
# robocasa is only tested where it is named: 1.3 GB, and a minute.
# Those whose tests take longest come first.
FAMILIES ?= lerobot hf torchrl libero libero_pro rcs ros
REQUIREMENTS := $(wildcard plugins/*/*/requirements)
TESTS_OF = $(foreach family,$(1),$(wildcard plugins/*/tests/families/$(family)))
TESTED_IN_libero := libero robosuite
TESTED_IN_hf := pi0 arro vjepa2_ac
TESTED_IN_lerobot06 := lerobot gr00t
TESTED_IN_gr00t_n1d7 := gr00t
TORCH_FROM := $(if $(TORCH_INDEX_URL),--index-url $(TORCH_INDEX_URL))

setup: $(STAMP)

# A part of the environment is enough; `make setup` installs the rest into the same folder.
demo: $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.demo)
	$(BIN)/vlagents-ray demo

# The reference policy from nothing in runs/reference, in two hours; an interrupted one continues.
reference: setup
	BIN=$(BIN) examples/reference/make.sh

# More than half an hour; the other policy servers get two environments of their own, .venv-peers and .venv-peers-torch.
bench: setup
	@mkdir -p build/bench
	$(BIN)/python -m benchmarks.peers
	$(BIN)/python -m benchmarks.rtt --peers all --out build/bench/rtt.json
	$(BIN)/python -m benchmarks.throughput --peers all --out build/bench/throughput.json
	$(BIN)/python -m benchmarks.evaluation --peers all --out build/bench/evaluation.json
	$(BIN)/python -m benchmarks.robots --out build/bench/robots.json

# GPU_PYTHON is one with torch and transformers. With DRY=1 the steps run in small sizes on a CPU. COMMIT names the commit in a
# copy without a git folder.
GPU_PYTHON ?= $(VENV)-hf/bin/python
gpu: $(if $(filter file default undefined,$(origin GPU_PYTHON)),$(VENV)-hf/.installed)
	$(GPU_PYTHON) -m benchmarks.gpu $(if $(RUN),--run $(RUN)) $(if $(DRY),--dry) $(if $(STEPS),--steps '$(STEPS)') $(if $(COMMIT),--commit '$(COMMIT)')

gpu-pack: setup
	$(BIN)/python -m benchmarks.gpu.pack

# Lint and types beside the tests, as each of them takes one core.
check: $(TOOLS)/.installed
	@$(MAKE) --no-print-directory --jobs=3 lint type quick

quick: $(TOOLS)/.installed
	@echo '== quick tests'
	$(TOOLS)/bin/pytest -n $(CHECK_PROCESSES) --dist loadfile --no-loadscope-reorder --hypothesis-profile=quick \
	  -m 'not ($(NOT_QUICK))'

# In another make: this one chose the environment of lint and types before there was a whole one. Types are checked beside the
# tests, as each of both leaves a core idle for a while.
test: setup
	@$(MAKE) --no-print-directory lint
	@$(MAKE) --no-print-directory --jobs=2 type played

played: collected
	@echo '== tests'
	$(call PLAY,not (integration))

# Once, beside mypy: pytest rewrites and compiles the test files, and Hypothesis finds the constants of the sources. Otherwise each
# of the processes that run tests would, at the same time.
collected: $(TOOLS)/.installed
	@printed=$$($(TOOLS)/bin/python -m pytest --collect-only -qq -m 'not (integration)' 2>&1) || { echo "$$printed"; exit 1; }

# All of them, whatever becomes of the first.
integrations: setup
	@status=0; $(MAKE) --no-print-directory --keep-going docs families || status=1; \
	  echo '== integrations'; $(call PLAY,integration) || status=1; exit $$status

# The tests of one tier, of the whole environment.
PLAY = VLAGENTS_RAY_ENVIRONMENTS=$(abspath $(VENV)) $(BIN)/python tests/support/play_again.py \
  -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder -m "$(1)"

# One after the other, as each installs this folder.
environments:
	@$(MAKE) --no-print-directory $(FAMILIES:%=$(VENV)-%/.installed)

# The tests of two at once. As where several processes run tests, the linear algebra of each has one thread: those of two wait for
# one another by spinning, on cores that the others need.
families: export OMP_NUM_THREADS := 1
families: export MKL_NUM_THREADS := 1
families: export OPENBLAS_NUM_THREADS := 1
families: environments
	@$(MAKE) --no-print-directory --jobs=2 --output-sync --keep-going $(FAMILIES:%=family-%)

family-%: $(VENV)-%/.installed
	@echo '== tests of $(or $(TESTED_IN_$*),$*), in $(VENV)-$*'
	$(VENV)-$*/bin/python tests/support/play_again.py $(call TESTS_OF,$(or $(TESTED_IN_$*),$*))

verified-%: $(VENV)-%/.installed
	$(VENV)-$*/bin/python -m pytest -p no:cacheprovider -m verifies --verified $(call TESTS_OF,$(or $(TESTED_IN_$*),$*))

verified:
	@$(MAKE) --no-print-directory $(addprefix verified-,$(filter-out libero libero_pro rcs ros torchrl,$(FAMILIES)))

# Each in an environment of its own; Stable-Baselines3 and TorchRL in folders beside the torch of this one. openpi's examples want OPENPI_SRC, and
# LeRobot 0.6 FAMILIES="lerobot lerobot06".
PROGRAMS := tests/programs plugins/vlagents_ray_learn/tests tests/integration/test_dialects.py tests/integration/test_gateways.py
programs: export STABLE_BASELINES3_SRC := $(CURDIR)/build/stable-baselines3
programs: export TORCHRL_SRC := $(CURDIR)/build/torchrl
programs: setup $(patsubst %,$(VENV)-%/.installed,$(filter lerobot%,$(FAMILIES)))
	$(PIP) install --quiet --no-deps --upgrade --target "$$STABLE_BASELINES3_SRC" stable-baselines3==2.9.2
	$(PIP) install --quiet --no-deps --upgrade --target "$$TORCHRL_SRC" torchrl==0.14.1 tensordict==0.14.3 pyvers==0.2.3
	status=0; options='-p no:cacheprovider -m program --verified'; \
	$(BIN)/python -m pytest $$options $(PROGRAMS) || status=1; \
	for family in $(filter lerobot%,$(FAMILIES)); do \
	  $(VENV)-$$family/bin/python -m pytest $$options plugins/vlagents_ray_models/tests/families/lerobot || status=1; done; \
	exit $$status

# Each in an environment of its own: Ray's with Python 3.11, and Pythons, where they are installed, with the newest Ray.
rays pythons: setup
	$(BIN)/python -m pytest -p no:cacheprovider --verified tests/programs/test_$@.py

# Made once for each state of the family's requirements, of what a server installs and of what `venv create` adds: not removed as a mere step.
.PRECIOUS: $(VENV)-%/.installed
vpath %.txt tests/requirements $(REQUIREMENTS)
$(VENV)-%/.installed: %.txt tests/requirements/testing.txt $(wildcard $(REQUIREMENTS:%=%/*.cpu.txt)) $(VENV)/server.txt \
    $(PROJECTS) \
    vlagents_ray/policies/base/import_fixes.py
	$(BIN)/vlagents-ray venv create $< $(addprefix --with ,tests/requirements/testing.txt $(wildcard tests/requirements/$*.testing.txt)) \
	  $(if $(TORCH_CUDA),--cuda) --out $(VENV)-$*
	@touch $@

# The reference of Python comes from the sources. For that of commands and settings, docs/hooks.py imports the server and its
# plug-ins, but no torch. With --quiet, MkDocs would count no warnings, and a strict build would never fail.
docs: $(TOOLS)/.installed
	@echo '== site of docs/, into build/docs'
	NO_MKDOCS_2_WARNING=1 $(TOOLS)/bin/mkdocs build --strict

extras locks: $(TOOLS)/.installed
	$(TOOLS)/bin/python tests/support/resolved.py $@ $(ONLY)

# The same wheels again from the same commit. Each folder of plugins/ is a distribution of its own.
PUBLISHING := build==1.6.1 twine==7.0.0 check-wheel-contents==0.6.3
dist: export SOURCE_DATE_EPOCH := $(shell git log -1 --format=%ct 2>/dev/null || date +%s)
dist:
	@$(if $(PYTHON),,$(error $(NO_PYTHON)))
	rm -rf dist build/publishing build/plugins && '$(PYTHON)' -m venv build/publishing
	build/publishing/bin/pip install --quiet $(PUBLISHING)
	build/publishing/bin/python -m build --outdir dist
	for folder in plugins/*/; do build/publishing/bin/python -m build --outdir build/plugins "$$folder"; done
	build/publishing/bin/twine check --strict dist/* build/plugins/*
	for wheel in dist/*.whl build/plugins/*.whl; do build/publishing/bin/check-wheel-contents "$$wheel"; done

# The pushed tag starts .github/workflows/release.yml. UPLOAD=1 uploads the files from here first: a package index accepts no
# trusted publisher for twelve projects that do not exist yet.
release:
	@$(if $(PYTHON),,$(error $(NO_PYTHON)))
	'$(PYTHON)' tests/support/release.py
	@$(MAKE) --no-print-directory dist
	$(if $(UPLOAD),build/publishing/bin/twine upload dist/* build/plugins/*)
	version=$$('$(PYTHON)' tests/support/release.py) && git tag --annotate --message "Version $$version" "v$$version" \
	  && git push origin "v$$version"

# CycloneDX, which its own schema has accepted, and a table. Whoever reads them installs nothing else of this folder.
LOCK ?= server-sim
sbom:
	@$(if $(PYTHON),,$(error $(NO_PYTHON)))
	@echo '== installing $(LOCK) and this package into build/sbom'
	rm -rf build/sbom && '$(PYTHON)' -m venv build/sbom/tools && '$(PYTHON)' -m venv --without-pip build/sbom/installed
	build/sbom/tools/bin/pip install --quiet 'pip>=24.3' cyclonedx-bom==7.5.0 pip-licenses==5.5.5
	build/sbom/tools/bin/pip --python build/sbom/installed/bin/python install --quiet --no-deps --require-hashes \
	  --requirement cluster/docker/locks/$(LOCK).txt
	build/sbom/tools/bin/pip --python build/sbom/installed/bin/python install --quiet --no-deps .
	build/sbom/tools/bin/cyclonedx-py environment --spec-version 1.6 --output-reproducible --pyproject pyproject.toml \
	  --output-file build/sbom/$(LOCK).cdx.json build/sbom/installed/bin/python
	build/sbom/tools/bin/pip-licenses --python build/sbom/installed/bin/python --from mixed --format markdown \
	  --output-file build/sbom/$(LOCK).licences.md

fmt: $(TOOLS)/.installed
	$(TOOLS)/bin/ruff check --fix .
	$(TOOLS)/bin/ruff format .

lint: $(TOOLS)/.installed
	@echo '== lint'
	$(TOOLS)/bin/ruff check .
	$(TOOLS)/bin/ruff format --check .
	$(TOOLS)/bin/codespell
	$(TOOLS)/bin/zizmor --quiet --offline --strict-collection --no-progress .github/workflows
	@echo '== layers'
	$(TOOLS)/bin/lint-imports

type: $(TOOLS)/.installed
	@echo '== types'
	$(TOOLS)/bin/mypy

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find vlagents_ray benchmarks plugins tests -type d -name __pycache__ -prune -exec rm -rf {} +

# Installed once for each state of all pyproject.toml, under the constraints of the torch that came first.
$(STAMP): $(PROJECTS) $(CONSTRAINTS)
	@echo '== installing vlagents-ray and its plug-ins $(PLUGINS) into $(VENV)'
	$(PIP) install --quiet --constraint $(CONSTRAINTS) --editable '.[dev]' \
	  $(foreach plugin,$(PLUGINS),--editable 'plugins/vlagents_ray_$(plugin)[dev]')
	$(PIP) check
	@touch $@

$(VENV)/.demo: pyproject.toml $(CONSTRAINTS)
	@echo '== installing what the demo needs into $(VENV)'
	$(PIP) install --constraint $(CONSTRAINTS) --editable '.[sim]'
	@touch $@

# What a server installs; as old as its last change, whatever else changes in pyproject.toml.
$(VENV)/server.txt: pyproject.toml | $(STAMP)
	@$(BIN)/python -c 'import tomllib; project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
	  print(*project["dependencies"], *project["optional-dependencies"]["serve"], sep="\n")' >$@.new
	@cmp -s $@.new $@ && rm $@.new || mv $@.new $@

$(VENV)-check/.installed: $(PROJECTS)
	@$(if $(PYTHON),,$(error $(NO_PYTHON)))
	'$(PYTHON)' -m venv $(VENV)-check
	@echo '== installing what the quick tests need into $(VENV)-check'
	$(VENV)-check/bin/python -m pip --disable-pip-version-check install --quiet --editable '.[check]' \
	  $(foreach plugin,$(PLUGINS),--editable plugins/vlagents_ray_$(plugin))
	@touch $@

# Torch first and alone, so that no other package chooses its build; the constraints hold it (and Ray, which
# server and clients must share) for whatever is installed into this environment later, too.
$(CONSTRAINTS): pyproject.toml | $(BIN)/python
	@echo '== installing torch into $(VENV)'
	@plan=$$($(PIP) install --quiet --dry-run --report - $(TORCH_FROM) '$(TORCH)'); \
	if ! grep -qiE '"name": *"(nvidia|cuda)-' <<<"$$plan" || [ -n '$(TORCH_CUDA)' ] \
	    || [ -e /dev/nvidia0 ] || nvidia-smi >/dev/null 2>&1; then \
	  $(PIP) install $(TORCH_FROM) '$(TORCH)'; \
	else \
	  echo '== without an NVIDIA GPU: the CPU build from PyTorch'"'"'s own index, several GB smaller'; \
	  $(PIP) install --quiet uv && \
	  $(BIN)/uv pip install --python $(BIN)/python --torch-backend cpu '$(TORCH)' || { \
	    echo '$(GOAL): stopped before downloading several GB: pip would take the CUDA build of $(TORCH), but this'; \
	    echo '  machine shows no NVIDIA GPU (no /dev/nvidia0, no working nvidia-smi), and the CPU build cannot be'; \
	    echo '  installed from PyTorch'"'"'s own index, as the lines above say. Choose one:'; \
	    echo '    make $(GOAL) TORCH_INDEX_URL=URL   another index with CPU-only wheels'; \
	    echo '    PIP_FIND_LINKS=FOLDER make $(GOAL) a folder that holds the CPU-only wheel'; \
	    echo '    make $(GOAL) TORCH_CUDA=1          the CUDA build after all; it also runs on a CPU'; \
	    exit 1; \
	  } >&2; \
	fi
	@$(PIP) freeze | grep '^torch==' >$@
	@sed -n 's/^ *"ray\[serve\]\([^"]*\)".*/ray\1/p' pyproject.toml >>$@
	@cat $@

$(BIN)/python:
	@$(if $(PYTHON),,$(error $(NO_PYTHON)))
	'$(PYTHON)' -m venv $(VENV)
	$(PIP) install --quiet --upgrade 'pip>=24.3'  # older ones download all of torch only to plan
