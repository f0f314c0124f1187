SHELL=/bin/bash
LINT_PATHS=sb3_causalgdp/ tests/ examples/ benchmarks/
RUFF_PATHS=${LINT_PATHS} docs/ notebooks/

pytest:
	pytest -n 2 tests/

mypy:
	mypy ${LINT_PATHS}

type: mypy

lint:
	ruff check ${RUFF_PATHS}

format:
	# Sort imports
	ruff check --select I ${RUFF_PATHS} --fix
	# Reformat
	ruff format ${RUFF_PATHS}

check-codestyle:
	# Sort imports
	ruff check --select I ${RUFF_PATHS}
	# Reformat
	ruff format --check ${RUFF_PATHS}

commit-checks: format type lint

doc:
	sphinx-build -W --keep-going -n -q docs docs/_build/html

clean:
	rm -rf build/ dist/ docs/_build/ *.egg-info .pytest_cache .mypy_cache .ruff_cache .coverage htmlcov

.PHONY: pytest mypy type lint format check-codestyle commit-checks doc clean
