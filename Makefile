# `make demo` and `make test` work on a fresh clone with Python 3.11 and make alone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
JOBS ?= 2

export OMP_NUM_THREADS ?= 1
# compiled once, and read by the many processes of the tests
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-fast coverage docs docs-only notebooks notebooks-smoke lint types imports check release install install-locked lock clean

install: $(VENV)/installed

# pip compiles one file after the other: compileall takes all cores; some packages ship files that do not compile
# torch first, at exactly the version of constraints.txt: a later resolver would bring CUDA builds
$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt torch numpy
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/python -m compileall -q -j 0 -x '/tests?/' $(VENV)/lib > $(VENV)/compiled.log || true
	touch $@

# the same of files whose hashes are known; only which build of torch it is, is left to the machine
install-locked:
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes -r constraints.lock
	$(BIN)/python -m pip install --quiet --no-deps -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $(VENV)/installed

# after a change of constraints.txt; 3.11.5: what soupsieve asks for
lock: install
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --no-deps --generate-hashes --python-version 3.11.5 --no-annotate --no-emit-package torch \
		--custom-compile-command 'make lock' constraints.txt -o constraints.lock

demo: install
	$(BIN)/torch-ekm demo --out demo_output

# files in their order: files of few tests, which may be the longest, would come last
test: install
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

# which lines the tests run: a summary here, htmlcov/index.html line by line
coverage: install
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder --cov=torch_ekm --cov-report=term:skip-covered --cov-report=html

# what most changes break first: description, kinematics, learners, f + g, QP, drivers and logs
FAST := description kinematics enhanced plant residual/test_residual_sogp_identities.py \
	residual/test_residual_parts.py control/test_control_qp.py control/test_control_controller.py
test-fast: install
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile $(addprefix tests/,$(FAST)) \
		--ignore=tests/description/test_description_hostile.py --ignore=tests/description/test_description_docs.py

# a first look at changed pages: what has changed is built again, warnings stay warnings
docs-only: install
	$(BIN)/python -m sphinx -n docs docs/_build/html

# the site, docs/_build/html/index.html; a warning is an error, and so is a link that leads nowhere
docs: install
	rm -rf docs/_build/html docs/reference/api/generated
	$(BIN)/python -m sphinx -E -W -n --keep-going docs docs/_build/html
	TORCH_EKM_SITE=docs/_build/html $(BIN)/python -m pytest -q tests/docs/test_docs_site.py tests/docs/test_docs_browser.py

# executed in place, outputs stored; 04 reads recordings in TORCH_EKM_DATA, 05 finished runs in TORCH_EKM_REPORTS
NBCONVERT := $(BIN)/jupyter nbconvert --to notebook --inplace
notebooks: install
	$(NBCONVERT) --execute --ExecutePreprocessor.record_timing=False --ExecutePreprocessor.timeout=1800 \
		$(wildcard notebooks/*.ipynb)
	$(NBCONVERT) --coalesce-streams $(wildcard notebooks/*.ipynb)

notebooks-smoke: install
	$(BIN)/python tests/notebooks/smoke.py build/notebooks
	$(BIN)/python -m pytest -o addopts="" -o timeout=600 --nbmake --nbmake-timeout=600 build/notebooks

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/pyright --pythonpath $(BIN)/python

imports: install
	$(BIN)/lint-imports

check: lint types imports test

# dates the changelog; sdist and wheel, checked in fresh environments by README's first two examples: the light core,
# then extra "sim"
PYTHONS ?= 3.11 3.12 3.13
release: install
	@test -n "$(REPOSITORY)" || { echo 'give its address: make release REPOSITORY=https://...'; exit 1; }
	grep -q '^\[project.urls\]' pyproject.toml || printf '\n[project.urls]\nRepository = "$(REPOSITORY)"\n' >> pyproject.toml
	v=$$($(BIN)/python -c 'import torch_ekm; print(torch_ekm.__version__)'); d=$$(date +%F); \
		sed -i.old "s/^## Unreleased$$/## $$v ($$d)/" CHANGELOG.md && rm CHANGELOG.md.old; \
		sed -i.old "s/^date-released: .*/date-released: $$d/" CITATION.cff && rm CITATION.cff.old; \
		grep -q "^## $$v" CHANGELOG.md && grep -q "^version: $$v" CITATION.cff && grep -q "version: \"$$v\"" recipe/recipe.yaml
	$(BIN)/python -m pip install --quiet build twine
	rm -rf dist && $(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	for n in 1 2; do awk -v n=$$n '/^```python/ {k++; p = k == n; next} /^```/ {p = 0} p' README.md > dist/example_$$n.py; done
	set -e; for v in $(PYTHONS); do \
		python$$v -m venv dist/check-$$v; \
		dist/check-$$v/bin/python -m pip install --quiet -c constraints.txt torch numpy; \
		dist/check-$$v/bin/python -m pip install --quiet -c constraints.txt dist/*.whl; \
		(cd dist && check-$$v/bin/python example_1.py); \
		dist/check-$$v/bin/python -m pip install --quiet -c constraints.txt "$$(ls dist/*.whl)[sim]"; \
		(cd dist && check-$$v/bin/python example_2.py); \
		echo "Python $$v: both examples run"; \
	done

clean:
	rm -rf $(VENV) demo_output htmlcov .coverage .pytest_cache .ruff_cache .hypothesis docs/_build docs/reference/api/generated docs/tutorials/notebooks
