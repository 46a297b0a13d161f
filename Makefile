# The commands of the project. A fresh machine needs `make` and Python 3.11 or newer; the rest goes into .venv.
.DEFAULT_GOAL := help
.NOTPARALLEL:
.DELETE_ON_ERROR:

PYTHONS := python3 python3.14 python3.13 python3.12 python3.11
VENV := .venv
BIN := $(VENV)/bin
RESULT := results/pendulum_delay
# A test waits for processes about half of its time, so four workers keep two cores busy. The long tests come first; with
# worksteal, a worker that has finished the short ones takes some of them.
PYTEST_ARGS ?= --numprocesses 4 --dist worksteal

.PHONY: help demo test coverage check docs bench fmus library clean

help: ## show this list
	@sed -n 's/^\([a-z]*\):[^#]*## \(.*\)/  make \1	\2/p' Makefile

demo: $(VENV)/.installed-plot ## the main job: two FMUs in two processes under a master, with result and plot
	@$(BIN)/fmu-mesh launch configs/pendulum_delay.yaml --plot $(RESULT).png

test: $(VENV)/.installed-test ## all tests; PYTEST_ARGS='-k name' replaces the arguments
	@$(BIN)/python -m pytest $(PYTEST_ARGS)

coverage: $(VENV)/.installed-test ## all tests, nodes and masters measured too, and the lines they leave out
	@$(BIN)/python -m coverage erase
	@$(BIN)/python -m coverage run -m pytest $(PYTEST_ARGS)
	@$(BIN)/python -m coverage combine --quiet
	@$(BIN)/python -m coverage report

# Every tool runs, so that one look shows all there is to mend.
check: $(VENV)/.installed-check $(VENV)/.installed-test ## lint, format, types, import layers, spelling
	@failed=; \
	run() { echo "== $$*"; "$(BIN)/$$@" || failed="$$failed\n  $$*"; }; \
	run ruff check; \
	run ruff format --check; \
	run mypy; \
	run lint-imports --no-logo; \
	run codespell; \
	if [ -n "$$failed" ]; then printf "\nmake check failed:$$failed\n" >&2; exit 1; fi; \
	echo "make check: all clean"

# A link that leads nowhere, a name that the reference cannot find, or a warning about a docstring ends the build.
docs: $(VENV)/.installed-docs ## the site, with the reference of the library: build/site/index.html
	@$(BIN)/python docs/site_pages.py build/pages
	@PATH="$(BIN):$$PATH" $(BIN)/zensical build --strict --clean >build/site.log 2>&1; code=$$?; cat build/site.log; \
	if [ $$code -ne 0 ] || grep -q '^griffe: ' build/site.log; then exit 1; fi

bench: $(VENV)/.installed-test ## us and the peers on this machine, and topics of ROS (about 25 minutes)
	@$(BIN)/python -m benchmarks
	@$(BIN)/python -m benchmarks.ros_topics

fmus: $(VENV)/.installed-plot ## rebuild the example FMUs from fmus/src (needs a C compiler)
	@$(BIN)/python fmus/build.py

library: $(VENV)/.installed-library ## rebuild the libraries of C from their sources (installs a compiler into .venv)
	@$(BIN)/python build_library.py

clean: ## remove results, builds and caches, but not .venv
	rm -rf results build dist .coverage .coverage.* .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

# A new dependency list installs anew, and so does a new environment.
$(VENV)/.installed-%: pyproject.toml $(VENV)/.created
	@echo "Installing fmu-mesh[$*] into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@# Where PYTHONDONTWRITEBYTECODE is set, every process of a mesh would compile all modules on its own: 0.2 s each.
	@$(BIN)/python -m compileall -q fmu_mesh
	@touch $@

# A name on PATH proves nothing (it may be a stand-in of a version manager), so each candidate has to run.
# An environment that works is kept, whoever made it.
$(VENV)/.created:
	@usable='import sys; sys.exit(sys.version_info < (3, 11))'; \
	if ! { $(BIN)/python -c "$$usable" && $(BIN)/python -m pip --version; } >/dev/null 2>&1; then \
	  python=; without_venv=; \
	  for candidate in $(PYTHONS); do \
	    $$candidate -c "$$usable" >/dev/null 2>&1 || continue; \
	    if $$candidate -c 'import ensurepip, venv' >/dev/null 2>&1; then python=$$candidate; break; fi; \
	    without_venv=$$candidate; \
	  done; \
	  if [ -z "$$python" ]; then \
	    if [ -n "$$without_venv" ]; then \
	      echo "$$without_venv has no module venv. On Debian and Ubuntu: apt install $$without_venv-venv" >&2; \
	    else \
	      echo "No Python 3.11 or newer on PATH (looked for: $(PYTHONS))." >&2; \
	    fi; \
	    exit 1; \
	  fi; \
	  echo "Creating $(VENV) with $$($$python --version) ..."; \
	  $$python -m venv --clear $(VENV) || exit 1; \
	fi; \
	touch $@
