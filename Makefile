SHELL=/bin/bash
LINT_PATHS=sb3_causalgdp/ tests/ examples/ benchmarks/

pytest:
	pytest -n 2 tests/

mypy:
	mypy ${LINT_PATHS}

type: mypy

lint:
	ruff check ${LINT_PATHS}

format:
	# Sort imports
	ruff check --select I ${LINT_PATHS} --fix
	# Reformat
	ruff format ${LINT_PATHS}

check-codestyle:
	# Sort imports
	ruff check --select I ${LINT_PATHS}
	# Reformat
	ruff format --check ${LINT_PATHS}

commit-checks: format type lint

doc:
	sphinx-build -W --keep-going -n -q docs docs/_build/html

clean:
	rm -rf build/ dist/ *.egg-info .pytest_cache .mypy_cache .ruff_cache .coverage htmlcov

.PHONY: pytest mypy type lint format check-codestyle commit-checks doc clean
