# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PYTEST := $(BIN)/pytest
# every test process and every task's child would compile the packages anew
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup gl demo ladder test bunny check bench figure4 figure7 results effects targets budgets sloan chen mitsuba cost-model tsai accuracy serve docs format lock clean
.DEFAULT_GOAL := help

help: ## List the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z0-9-]+):.*## /  make \1\t/' | expand -t 16

setup: $(STAMP) ## Build .venv with everything in it

$(STAMP): requirements/dev.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "prtbake needs Python 3.11 or newer; set PYTHON=..." >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

gl: ## Install the two system packages that GL previews need, or name them
	@if ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' && ldconfig -p | grep -q 'libGL\.so\.1'; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  apt-get update -qq && apt-get install -y -qq --no-install-recommends libegl1 libgl1 >/dev/null \
	  || echo "Could not install libegl1 and libgl1: the CPU renderer serves instead."; \
	else \
	  echo "GL previews need the system packages libegl1 and libgl1 (apt-get install libegl1 libgl1);"; \
	  echo "without them the CPU renderer serves instead."; \
	fi

demo: setup gl ## Run the main job on the teapot: asset, preview, validation and report in demo-output/
	$(BIN)/prtbake demo --to demo-output

ladder: setup gl ## What accuracy costs: draft, medium and high beside each other, in demo-output/
	$(BIN)/prtbake demo --ladder --to demo-output

test: setup gl ## All tests that need nothing but the repository
	OPENBLAS_NUM_THREADS=1 $(PYTEST) -q -n 2 --dist loadfile -m "not acceptance and not real_data"
	$(PYTEST) -q -m "acceptance and not real_data"

bunny: setup gl ## Kill a worker in the middle of the bunny's bake, on both databases (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	$(PYTEST) -q -m long

check: setup ## Format, lint, types, layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup ## Format and mend what can be mended
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: setup ## Speed, memory and error beside a limit measured in the same run
	$(BIN)/python tests/benchmarks/run.py

figure4: setup ## Tsai and Shih's figure 4 in numbers: lights of as many parameters, in figure4-output/
	OPENBLAS_NUM_THREADS=1 PYTHONPATH=tests $(BIN)/python -m figures.figure4 --to figure4-output

figure7: setup ## Sloan's figure 7 in numbers: hemispherical projections compared, in figure7-output/
	PYTHONPATH=tests $(BIN)/python -m figures.figure7 --to figure7-output

results: setup gl ## Measure bunny, Spot and shaderball anew, into docs/measured and docs/images (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	$(BIN)/python tests/measured/run.py

effects: setup ## Hold planning against what effects cost and bring, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/effects.py

targets: setup ## Hold errors asked of compression against delivered files, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/targets.py

budgets: setup gl ## Hold budgets of assets against what came, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/budgets.py

sloan: setup ## Redo the clustered PCA of Sloan's paper, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/sloan.py

chen: setup ## Chen's tables of overdraw anew, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/chen.py

mitsuba: setup ## Hold baked scenes against Mitsuba 3, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/against_mitsuba.py

tsai: setup ## Redo Tsai and Shih's tables 1 and 2, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/tsai.py

accuracy: setup gl ## What accuracy costs: frontiers, the ladder and lights, into docs/measured (PRTBAKE_DATA=...)
	@test -n "$$PRTBAKE_DATA" || { echo "PRTBAKE_DATA must name the folder of the real data" >&2; exit 1; }
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/measured/accuracy.py

cost-model: setup gl ## Hold predicted seconds, bytes and memory against 60 random jobs, into docs/measured
	$(BIN)/python tests/measured/cost_model.py --anew

serve: setup gl ## Service and two workers on loopback
	$(BIN)/prtbake serve

docs: setup ## Build the documentation, strictly
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict

lock: ## Pin and hash the requirements (needs uv)
	uv pip compile -q pyproject.toml --python-version 3.11 --extra workers --generate-hashes --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o requirements/workers.txt
	uv pip compile -q pyproject.toml --python-version 3.11 --extra server --generate-hashes --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o requirements/server.txt
	uv pip compile -q pyproject.toml --python-version 3.11 --extra workers --group dev --generate-hashes --no-header --no-annotate --no-emit-index-url --no-emit-find-links -o requirements/dev.txt

clean: ## Remove what the other targets built
	rm -rf $(VENV) site demo-output figure4-output figure7-output results-output dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
