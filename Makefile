# Everything on a fresh machine with git, make and Python 3.11+: `make demo`, `make test`, `make check`.
# Choose the Python by `make PYTHON=python3.12 ...`; the virtual environment is .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: help demo test thorough chaos cluster compose check scoreboard audit docs release-check format clean egl

help:
	@echo "make demo    attack an object that comes with Trompe; results in trompe-demo/"
	@echo "make test    run the tests (those with real objects too, if TROMPE_ASSETS names their folder)"
	@echo "make thorough  run the tests on further cases (7 minutes)"
	@echo "make chaos   kill, freeze and stop the service's processes while it works (6 minutes)"
	@echo "make cluster run jobs on Ray clusters of simulated nodes (4 minutes)"
	@echo "make compose build the images and test the stack of docker-compose.yml (needs Docker)"
	@echo "make scoreboard ROW=name  measure speed and accuracy (under 20 minutes; needs TROMPE_ASSETS)"
	@echo "make audit   look for known faults in what is installed, and write its list to out/sbom.json"
	@echo "make docs    build the documentation as a site in out/docs"
	@echo "make release-check  build wheel and sdist into dist/, check them, install the wheel and run the demo"
	@echo "make check   format, lint, types, import rules"
	@echo "make format  put the code into its form"
	@echo "make clean   remove .venv, caches and trompe-demo/"

demo: $(VENV)/.installed-server egl
	$(BIN)/trompe demo --out trompe-demo

test: $(VENV)/.installed-dev egl
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

thorough: $(VENV)/.installed-dev egl
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder -m thorough

chaos: $(VENV)/.installed-dev egl
	$(BIN)/python -m pytest -m "chaos and not slow" tests/service/test_chaos.py

cluster: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m cluster tests/service

compose: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m compose tests/compose -v -o log_cli=true -o log_cli_level=INFO

check: $(VENV)/.installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Finished jobs stay in out/scoreboard: a stopped run goes on.
scoreboard: $(VENV)/.installed-dev egl
	$(BIN)/python -m bench.scoreboard --row "$(or $(ROW),$(error make scoreboard ROW=name))"

# The auditors have an environment of their own, so that they do not find themselves.
audit: $(VENV)/.installed-dev
	$(PYTHON) -m venv $(VENV)/audit
	$(VENV)/audit/bin/pip install --quiet pip-audit cyclonedx-bom
	mkdir -p out
	$(VENV)/audit/bin/cyclonedx-py environment --output-format JSON --output-file out/sbom.json $(BIN)/python
	$(BIN)/pip freeze --exclude-editable | sed 's/+cpu//' >out/installed.txt
	$(VENV)/audit/bin/pip-audit --strict --no-deps --disable-pip -r out/installed.txt

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# What users install, in environments of its own: first without an extra, which names the missing one in one line.
RELEASE := out/release
NEWER ?= $(wildcard /usr/bin/python3.1[2-9] $(HOME)/.pyenv/versions/3.1[2-9].*/bin/python3)
release-check:
	rm -rf dist $(RELEASE)
	$(PYTHON) -m venv $(RELEASE)/tools
	$(RELEASE)/tools/bin/pip install --quiet build twine
	$(RELEASE)/tools/bin/python -m build --outdir dist
	$(RELEASE)/tools/bin/twine check --strict dist/*
	$(PYTHON) -m venv $(RELEASE)/bare
	$(RELEASE)/bare/bin/pip install --quiet dist/*.whl
	cd $(RELEASE) && ! bare/bin/trompe demo >said 2>&1 && cat said
	test "$$(wc -l <$(RELEASE)/said)" = 1 && grep -qF "pip install 'trompe[server]'" $(RELEASE)/said
	$(RELEASE)/bare/bin/pip install --quiet -c constraints.txt "$$(echo dist/*.whl)[server]"
	cd $(RELEASE) && bare/bin/trompe demo --out demo && test -s demo/result.json
	cd $(RELEASE) && bare/bin/trompe attack mug --label mug --epsilon 0.1 --steps 10 --grid --azimuths 3 --elevations 2 --out mug
# The renderer also on newer Pythons, where there are any: pyrender's OpenGL is older than they are.
	for python in $(NEWER); do rm -rf $(RELEASE)/newer && $$python -m venv $(RELEASE)/newer \
	  && $(RELEASE)/newer/bin/pip install --quiet -c constraints.txt "$$(echo dist/*.whl)[renderer]" \
	  && $(RELEASE)/newer/bin/trompe render --check || exit 1; done

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache trompe-demo

# One environment; the stamp of an extra is renewed when the requirements change.
$(VENV)/.installed-%: pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/pip install -c constraints.txt -e '.[$*]'
	touch $@

$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Trompe needs Python 3.11 or newer as $(PYTHON); choose another by make PYTHON=..."; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
	  || { rm -rf $(VENV); echo "Python's venv module is missing: sudo apt-get install python3-venv"; exit 1; }

# The renderer draws through EGL, in software where there is no GPU.
EGL_PACKAGES := libegl1 libgl1 libgl1-mesa-dri
SUDO = $(if $(filter 0,$(shell id -u)),,sudo -n)

egl:
	@$(PYTHON) -c 'import ctypes; ctypes.CDLL("libEGL.so.1"), ctypes.CDLL("libGL.so.1")' 2>/dev/null \
	  || { $(SUDO) apt-get update && $(SUDO) apt-get install -y --no-install-recommends $(EGL_PACKAGES); } \
	  || { echo "The renderer needs EGL. On Debian: sudo apt-get install $(EGL_PACKAGES)"; exit 1; }
