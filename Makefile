# make demo   set everything up, then compare PRDP with constant K on the 1D heat equation
# make test   set everything up, then run all C++ and Python tests
# Each step leaves a stamp, so that a second call does no work twice.
PYTHON ?= python3
BIN := .venv/bin
STAMPS := .stamps
export PATH := $(CURDIR)/$(BIN):$(PATH)
export MAKEFLAGS :=

.PHONY: demo test build clean

demo: build
	$(BIN)/prdp compare heat_1d

test: build
	$(BIN)/ruff check --quiet . && $(BIN)/ruff format --check --quiet .
	$(BIN)/ctest --test-dir build --output-on-failure
	$(BIN)/pytest

# Headers that no pip package carries; one sentence where they cannot be installed.
$(STAMPS)/system:
	cmake/system-packages.sh
	@mkdir -p $(STAMPS) && touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "prdp: this Python cannot make virtual environments; apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv .venv

$(STAMPS)/python: requirements.txt | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.txt
	@mkdir -p $(STAMPS) && touch $@

$(STAMPS)/install: pyproject.toml setup.py $(STAMPS)/system $(STAMPS)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	@touch $@

build: $(STAMPS)/install
	$(BIN)/cmake --build build --parallel $$(nproc)
	@$(BIN)/cmake --install build --component python --prefix prdp_torch > build/install.log

clean:
	rm -rf .venv .stamps build runs prdp_torch/*.so prdp_torch/built_for_torch.txt *.egg-info
