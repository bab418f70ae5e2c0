# Two commands do everything on a fresh machine, set-up included: `make demo` and `make test`.
.PHONY: setup demo demo-bag test lint docs pages options reliability platforms results

PYTHON = .venv/bin/python
# Tests and commands start many processes: without kept bytecode each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

setup:
	@scripts/setup.sh

demo: setup
	$(PYTHON) scripts/demo.py

# The committed filter of the bag, or another, and the policy to be shielded, or none (BASE=):
# make demo-bag POLICY=<filter> BASE=<policy>
# Or a filter that is trained first, which sees by an encoder: make demo-bag ENCODER=facebook/dinov2-small
POLICY ?= bag
BASE ?= bag_diffusion_weak
# Linux draws without a display by EGL; a Mac has its own way and refuses the name.
ifeq ($(shell uname -s),Linux)
demo-bag: export MUJOCO_GL ?= egl
endif
demo-bag: setup
	$(if $(ENCODER),@scripts/setup_dino.sh)
	$(PYTHON) scripts/demo_bag.py --policy="$(POLICY)" $(if $(BASE),--base="$(BASE)") $(if $(ENCODER),--encoder="$(ENCODER)")

test: lint
	HF_HUB_OFFLINE=1 $(PYTHON) -m pytest -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder
	$(PYTHON) scripts/fill_results.py --check

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/lint-imports --no-logo
	.venv/bin/mypy
	.venv/bin/interrogate lerobot_latentsafe

SPHINX = HF_HUB_OFFLINE=1 .venv/bin/sphinx-build -W --keep-going -q -b html

# The pages, with the notebook executed, into docs/_build/html: ten minutes where it was not executed before.
docs: setup
	$(SPHINX) docs docs/_build/html

# The pages as they are, half a minute: do all references lead somewhere?
pages: setup
	$(SPHINX) -D nb_execution_mode=off -D suppress_warnings=myst-nb.lexer docs docs/_build/pages

# lerobot_latentsafe/cli/options.json, by the option classes: after a change of any option.
options: setup
	$(PYTHON) scripts/write_options.py

# docs/reliability.md, by the tests of all faults.
reliability: setup
	HF_HUB_OFFLINE=1 $(PYTHON) scripts/reliability.py

# Can requirements.lock be installed on each platform? Asks the package index.
platforms: setup
	scripts/check_platforms.sh

results: setup
	scripts/reproduce_dubins.sh
