PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Order and what stays together on a core: tests/conftest.py.
ON_ALL_CORES := --numprocesses auto --dist loadscope --no-loadscope-reorder

.PHONY: demo test test-quick lint docs pictures protocol package clean

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.installed-test: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	touch $@

demo: $(VENV)/.installed
	$(BIN)/optical-palpation demo --output demo-output

# All tests, on all cores; PYTEST_OPTIONS goes to pytest.
test: $(VENV)/.installed-test
	$(BIN)/python -m pytest $(ON_ALL_CORES) $(PYTEST_OPTIONS)

# Those that take no time, for after every change.
test-quick: $(VENV)/.installed-test
	$(BIN)/python -m pytest $(ON_ALL_CORES) -m quick $(PYTEST_OPTIONS)

lint: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(VENV)/.installed-test
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs-output

# The pictures of README and docs, made anew; needs Chromium and Xvfb.
pictures: $(VENV)/.installed-test
	$(BIN)/python docs/pictures.py
	xvfb-run -a -s "-screen 0 1600x1000x24" $(BIN)/python -W ignore benchmarks/viewer_pictures.py docs/viewer

# The numbers of docs/protocol.md, made anew.
protocol: $(VENV)/.installed-test
	$(BIN)/python docs/protocol.py

package: $(VENV)/.installed-test
	.ci/package

clean:
	rm -rf $(VENV) demo-output docs-output jupyter_execute docs/_generated
