# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0

# Everything runs in .venv, which is made at the first call. Where a ROS 2 is sourced the
# environment sees the packages of the system and uses that ROS; elsewhere it has its own from
# PyPI. The two do not mix, so that sourcing ROS later makes the environment anew.

# Tests start hundreds of processes, which compile the package anew if they may not keep bytecode.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= python3
PYTEST_ARGS ?=
# --open shows the report of the demo in a browser
DEMO_ARGS ?=
TEST_PROCESSES ?= 4
PYTHONS ?= python3.10 python3.11 python3.12 python3.13

VENV := .venv
BIN := $(VENV)/bin
ifeq ($(and $(ROS_DISTRO),$(shell $(PYTHON) -c 'import rclpy; print("found")' 2>/dev/null)),)
KIND := pypi
OTHER := system
EXTRAS := test,ros
DEMO_EXTRAS := [ros]
else
KIND := system
OTHER := pypi
EXTRAS := test
VENV_FLAGS := --system-site-packages
endif
STAMP := $(VENV)/.ready-$(KIND)
EXTRAS_STAMP := $(VENV)/.extras-$(KIND)
DEMO_STAMP := $(VENV)/.demo-$(KIND)
DOCS_STAMP := $(VENV)/.docs-$(KIND)
LINT := $(VENV)-lint
LINT_STAMP := $(LINT)/.ready
# Today's ouster-sdk pins a rosbags that is too old for bags/: pip would complain at each
# installation. The one that the extra `ouster` takes needs an older numpy, hence its environment.
OUSTER := $(CURDIR)/$(VENV)/ouster
OUSTER_ENV := $(CURDIR)/$(VENV)-ouster

.PHONY: demo test test-extras ouster boundscheck versions bench soak lint format docs dist notebooks settings clean

# The environment of the tests does too, and the one of the demo becomes it later.
demo: $(or $(wildcard $(STAMP)),$(DEMO_STAMP))  ## simulate a street, map it live over DDS and from the bag, compare
	$(BIN)/python examples/demo.py $(DEMO_ARGS)

# Each process takes the next file of tests, in the order of test/conftest.py, when it is done with
# one, and has a ROS domain of its own. Four keep two cores busy, as tests of nodes wait for each
# other. TEST_PROCESSES=0 runs all in this process. A thread of BLAS that waits for work computes:
# with one in each process the models need a tenth less.
TESTS = OPENBLAS_NUM_THREADS=1 PYTHONPATH=$(OUSTER)$${PYTHONPATH:+:$$PYTHONPATH} \
	$(BIN)/python -m pytest -q -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder

test: $(STAMP)  ## all tests but those of optional packages that take 1.1 GB
	$(TESTS) --durations=5 $(PYTEST_ARGS)

test-extras: $(EXTRAS_STAMP)  ## the files of tests that `make test` skips or runs in part
	$(TESTS) -rs $$(grep -rlE --include='test_*.py' 'import (.*, )?extras' test) $(PYTEST_ARGS)

ouster: $(EXTRAS_STAMP) $(OUSTER_ENV)/.ready  ## read the packets of an Ouster lidar with the extra `ouster` alone
	PYTHONPATH=$(OUSTER)$${PYTHONPATH:+:$$PYTHONPATH} \
	SURFEL_MAPPER_OUSTER_PYTHON=$(OUSTER_ENV)/bin/python \
	$(BIN)/python -m pytest -q test/offline/test_ouster_pcap.py

# Compiled code reads past the end of an array without an error. Compiled with checks it cannot;
# the cache is a new one, because cached kernels keep the setting they were compiled with. At the
# end every kernel has to have been compiled, that is, called by a test.
boundscheck: $(STAMP)  ## the tests of kernels against their references, with every index checked
	cache=$$(mktemp -d) && trap 'rm -rf "$$cache"' EXIT && \
	export NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR="$$cache" && \
	$(BIN)/python -m pytest -q -n $(TEST_PROCESSES) --dist loadfile \
		$$($(BIN)/python -m test.kernels.references) $(PYTEST_ARGS) && \
	$(BIN)/python -m test.kernels.reached "$$cache"

versions:  ## one bag, one digest, on every Python of PYTHONS that is there
	@for python in $(PYTHONS); do \
		"$$python" --version || continue; \
		directory=$(VENV)-versions/$$("$$python" -c 'import sys; print(sys.version.split()[0])'); \
		"$$python" -m venv "$$directory" && \
		"$$directory/bin/python" -m pip install -q --disable-pip-version-check -e '.[test]' && \
		"$$directory/bin/python" -m pytest -q -p no:cacheprovider test/test_determinism.py || exit 1; \
	done

bench: $(STAMP)  ## milliseconds a scan
	$(BIN)/python -m test.bench

soak: $(STAMP)  ## a million scans: does memory grow, do times, does the map drift?
	$(BIN)/python -m test.soak

lint: $(LINT_STAMP)  ## style, format, types, layers, language; needs no ROS
	$(LINT)/bin/ruff check
	$(LINT)/bin/ruff format --check
	$(LINT)/bin/mypy
	$(LINT)/bin/python -m pytest -q test/test_layering.py test/test_language.py

format: $(LINT_STAMP)  ## write every file in the one format, imports sorted
	$(LINT)/bin/ruff check --fix
	$(LINT)/bin/ruff format

docs: $(DOCS_STAMP)  ## build site/ from docs/ and the docstrings, without a warning, links checked
	$(BIN)/python -m pytest -q test/docs/test_pages.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict  # its theme's advertisement
	@echo 'site/index.html'

dist: $(DOCS_STAMP)  ## build wheel and sdist into dist/; run tests of the sdist, and the wheel in an empty environment
	rm -rf dist build
	$(BIN)/python -m build --outdir dist
	@check=$$(mktemp -d) && trap 'rm -rf "$$check"' EXIT && \
	tar -xzf dist/*.tar.gz -C "$$check" --strip-components=1 --one-top-level=sdist && \
	PYTHONPATH="$$check/sdist" $(BIN)/python -m pytest -q -p no:cacheprovider \
		--rootdir "$$check/sdist" -c "$$check/sdist/setup.cfg" "$$check"/sdist/test/test_p*.py && \
	$(PYTHON) -m venv "$$check/venv" && \
	"$$check/venv/bin/python" -m pip install -q --disable-pip-version-check dist/*.whl && \
	cd "$$check" && venv/bin/surfel-mapper simulate street --output street --scans 3 --columns 256 && \
	venv/bin/surfel-mapper replay street --output mapped

notebooks: $(EXTRAS_STAMP)  ## write the notebooks of the tutorials from their pages, and run them
	$(BIN)/python -m test.docs.notebooks

settings: $(STAMP)  ## write default.yaml and the table of docs/settings.md from config/
	$(BIN)/python -m test.settings

clean:  ## remove the environment and everything built
	rm -rf $(VENV) $(LINT) $(OUSTER_ENV) $(VENV)-versions build install log dist site demo *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find surfel_mapper test -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): setup.py pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	{ echo 'Python 3.10 or newer is needed: make PYTHON=python3.12 ...' >&2; exit 1; }
	@echo 'Once: packages from PyPI into $(VENV)/, about 250 MB to download, 1.0 GB on the disk'
	$(PYTHON) -m venv $(VENV_FLAGS) $(if $(wildcard $(VENV)/.ready-$(OTHER)),--clear) $(VENV)
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[$(EXTRAS)]'
	touch $@

$(EXTRAS_STAMP): $(STAMP)
	@echo 'Once: optional packages from PyPI into $(VENV)/, about 320 MB to download, 1.1 GB on the disk'
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[$(EXTRAS),full]'
	$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --upgrade \
		--target $(OUSTER) 'ouster-sdk>=1,<2' more-itertools
	touch $@

$(OUSTER_ENV)/.ready: setup.py pyproject.toml
	$(PYTHON) -m venv $(OUSTER_ENV)
	$(OUSTER_ENV)/bin/python -m pip install -q --disable-pip-version-check -e '.[ouster]'
	touch $@

$(DEMO_STAMP): setup.py pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	{ echo 'Python 3.10 or newer is needed: make PYTHON=python3.12 ...' >&2; exit 1; }
	@echo 'Once: packages from PyPI into $(VENV)/, about 190 MB to download, 750 MB on the disk'
	$(PYTHON) -m venv $(VENV_FLAGS) $(if $(wildcard $(VENV)/.ready-$(OTHER)),--clear) $(VENV)
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.$(DEMO_EXTRAS)'
	touch $@

$(LINT_STAMP): setup.py setup.cfg
	$(PYTHON) -m venv $(LINT)
	$(LINT)/bin/python -m pip install -q --disable-pip-version-check -e '.[lint]'
	touch $@

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install -q --disable-pip-version-check -e '.[docs]'
	touch $@
