# make run    set everything up in .venv/ and start the simulated stack
# make test   format, lint, types and all tests
# make check  format, lint and types; the page too, where Node.js is installed
# make lock   write requirements*.lock anew after a change of constraints.txt or pyproject.toml (needs network)
# make newest the unit tests with the newest version of everything, in .venv-newest/ (PYTHON=python3.13)
# make fuzz   a thousand times the mutated inputs of `make test` for each parser of outside bytes: hours (ARGS="-k glb")
# make clean  take away what these made
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
ARGS   ?=

.PHONY: run test newest check fuzz clean install install-tests lock chromium

run: $(STAMP)
	@exec $(BIN)/ic launch sim $(ARGS)

# The system tests start whole stacks, which want the machine for themselves: they run after the others, one by one,
# and also where one of the others failed.
test: check install-tests chromium
	@units=passed; systems=passed; \
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "not system" --durations 10 || units=FAILED; \
	$(BIN)/python -m pytest -m system --durations 10 || systems=FAILED; \
	echo "make test: unit tests $$units, system tests $$systems"; \
	test $$units$$systems = passedpassed

NEWEST := .venv-newest
newest:
	@options=$$($(PYTHON) scripts/newest.py $(NEWEST)) || exit; \
	$(NEWEST)/bin/ic compile || { echo "make newest: ic compile FAILED"; exit 1; }; \
	units=passed; \
	$(NEWEST)/bin/python -m pytest -n 2 --dist loadgroup -m "not system" $$options $(ARGS) || units=FAILED; \
	echo "make newest: $$($(NEWEST)/bin/python -V), unit tests $$units"; \
	test $$units = passed

check: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	scripts/check_js.sh

fuzz: $(STAMP)
	FUZZ=1000 $(BIN)/python -m pytest -n auto --timeout 0 tests/fuzz/test_fuzz.py $(ARGS)

install: $(STAMP)

# Only files whose hash is in the lock are installed, and no source distributions: their build would run unlocked code.
# torch apart: an index would give its CUDA build of several gigabytes.
PIP := $(BIN)/python -m pip install -q --disable-pip-version-check --progress-bar off
$(STAMP): pyproject.toml constraints.txt requirements.lock scripts/install_torch.sh
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11 run")'
	@echo "Setting up $(VENV)/ (about four minutes, once)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "  the packages of requirements.lock ..."
	@$(PIP) --require-hashes --only-binary :all: -r requirements.lock
	@echo "  torch (CPU build) ..."
	@scripts/install_torch.sh $(BIN)/python
	@$(PIP) --no-deps --no-build-isolation -e .
	@$(BIN)/ic compile
	@touch $@

# What the tests need and a run does not: triton, 200 MB, which compiles the GPU's kernels without a GPU too.
TESTS_STAMP := $(VENV)/.installed-tests
install-tests: $(TESTS_STAMP)
$(TESTS_STAMP): $(STAMP) requirements-test.lock
	@echo "  the packages of requirements-test.lock ..."
	@$(PIP) --require-hashes --only-binary :all: -r requirements-test.lock
	@touch $@

lock:
	@PYTHON=$(PYTHON) scripts/lock.sh

# The browser test drives Debian's Chromium. Without root it must be there already, else those tests say they skip.
chromium:
	@scripts/ensure_chromium.sh

clean:
	rm -rf $(VENV) $(NEWEST) tests/console/js/node_modules build dist runs .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
