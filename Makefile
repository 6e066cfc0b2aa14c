# `make demo` and `make test` need nothing but Python, git and make: they build their environment in .venv themselves.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Each test process computes on one thread; two of them run side by side.
ONE_THREAD := OMP_NUM_THREADS=1

.PHONY: demo test browser lint known-fronts first-records evidence wall-clock comparison beyond ideas reduced rounding sweep-throughput speed torture compat docs linkcheck clean

demo: $(VENV)/installed
	$(BIN)/python examples/demo.py

test: $(VENV)/tools browser
	$(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist worksteal

# What the explorer's tests need of the system: a browser, and OpenGL that draws without a window.
browser:
	@if command -v chromium >/dev/null && ldconfig -p | grep -q libEGL.so.1; then exit 0; fi; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium libegl1 libgl1-mesa-dri >/dev/null; \
	fi || true; \
	command -v chromium >/dev/null && ldconfig -p | grep -q libEGL.so.1 || \
		echo "make browser: chromium or libegl1 is missing and could not be installed; tests that need them will say so."

lint: $(VENV)/tools
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The evidence of docs/results.md, too slow for every test: an hour and more on two cores.
known-fronts: $(VENV)/tools
	$(ONE_THREAD) $(BIN)/python -m tests.known_fronts

first-records: $(VENV)/installed
	$(BIN)/python -m sb3_momba.benchmark run --conf momba capql capql_uniform --env MO-HalfCheetah-v4 MO-Hopper-v4 \
		--seeds 2 --steps 3e4 --eval-freq 5e3 --auto-ent-coef 0.01 --output runs/first --report

EVIDENCE := --env MO-HalfCheetah-v4 MO-Hopper-v4 MO-Walker2d-v4 --seeds 4 --steps 5e4 --eval-freq 5e3

evidence: $(VENV)/installed
	$(BIN)/python -m sb3_momba.benchmark run --conf capql capql_uniform $(EVIDENCE) --output runs/evidence/baselines
	$(BIN)/python -m sb3_momba.benchmark run --conf momba her_par $(EVIDENCE) --auto-ent-coef 0.01 \
		--set precision=auto --set compile=true --output runs/evidence/momba
	$(BIN)/python -m sb3_momba.benchmark report runs/evidence

# CAPQL for as long as Momba takes: six hours of one core.
wall-clock: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf capql_uniform --env MO-HalfCheetah-v4 MO-Hopper-v4 --seeds 4 \
		--steps 3e5 --eval-freq 1e4 --label "capql_uniform, as long" --output runs/wall_clock

# The baselines beside it at the same number of steps (two hours of one core), and PGMORL and DPMORL at 1,000,000 (three hours).
EQUAL := --env MO-HalfCheetah-v4 MO-Walker2d-v4 MO-Hopper-v4 --seeds 3
OWN := --env MO-HalfCheetah-v4 --seeds 3

comparison: $(VENV)/tools
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf pgmorl $(EQUAL) --steps 49920 --eval-freq 9984 \
		--set steps_per_iteration=1664 --set num_envs=1 --output runs/comparison/pgmorl
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf dpmorl dpmorl_state $(EQUAL) --steps 5e4 --eval-freq 1e4 --set n_envs=1 \
		--output runs/comparison/dpmorl
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf gpi_ls_utd_1 --env MO-HalfCheetah-v4 MO-Walker2d-v4 --seeds 3 \
		--steps 5e4 --eval-freq 1e4 --output runs/comparison/gpi_ls
	$(BIN)/python -m sb3_momba.benchmark report runs/evidence runs/comparison --output runs/comparison
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf pgmorl $(OWN) --steps 983040 --eval-freq 98304 \
		--label "pgmorl, 1M" --output runs/million/pgmorl
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf dpmorl $(OWN) --steps 1e6 --eval-freq 1e5 \
		--label "dpmorl, 1M" --output runs/million/dpmorl
	$(BIN)/python -m sb3_momba.benchmark report runs/million

# Beyond the thesis: thirteen hours of one core.
beyond: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --conf momba_plus --env MO-HalfCheetah-v4 MO-Hopper-v4 MO-Walker2d-v4 MO-Swimmer-v4 \
		--seeds 3 --steps 2e5 --eval-freq 1e4 --set precision=auto --set compile=true --output runs/beyond
	$(BIN)/python -m sb3_momba.benchmark report docs/results/evidence runs/beyond --output runs/beyond

# What each idea gives to it, on HalfCheetah at a learning rate that falls as fast as over 100,000 steps: 62 runs and 18 of some ten
# minutes of one core.
IDEAS := --seeds 2 --steps 3e4 --set precision=auto --set compile=true

ideas: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --grid ideas --env MO-HalfCheetah-v4 $(IDEAS) \
		--set learning_rate=lin_3e-4_2.19e-4 --output runs/ideas/halfcheetah --report
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark run --grid ideas_swimmer --env MO-Swimmer-v4 $(IDEAS) \
		--output runs/ideas/swimmer --report

# The ablations of chapter 4 in short, on one task, grid after grid, the dearest last: 72 runs, of which 34 cost a core half an hour
# (AVX-512 with bfloat16), and those of more updates or wider critics a multiple.
reduced: $(VENV)/installed
	$(BIN)/python -m sb3_momba.benchmark run --grid value_representation normalization her_par conditioning utd critic_scaling \
		--env MO-HalfCheetah-v4 --seeds 2 --steps 3e4 --eval-freq 5e3 --auto-ent-coef 0.01 \
		--set precision=auto --set compile=true --output runs/reduced
	$(BIN)/python -m sb3_momba.benchmark chapter4 runs/reduced

rounding: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m tests.rounding

torture: $(VENV)/tools
	$(ONE_THREAD) $(BIN)/python -m tests.torture

# Stable-Baselines3's own tests with MOMBA in SAC's place.
compat: $(VENV)/tools
	$(ONE_THREAD) $(BIN)/python -m tests.compat

sweep-throughput: $(VENV)/tools
	$(BIN)/python -m tests.sweep_throughput

speed: $(VENV)/installed
	$(ONE_THREAD) $(BIN)/python -m sb3_momba.benchmark speed --threads 1

# Warnings are errors.
SPHINX := $(BIN)/python -m sphinx -W --keep-going -n

docs: $(VENV)/tools
	$(SPHINX) -b html docs docs/_build/html

# Asks the network whether links to elsewhere still lead somewhere.
linkcheck: $(VENV)/tools
	$(SPHINX) -b linkcheck docs docs/_build/linkcheck

$(VENV)/installed: setup.py constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade -c constraints.txt pip setuptools
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/tools: $(VENV)/installed
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[test]"
	touch $@

clean:
	rm -rf $(VENV) build docs/_build *.egg-info .pytest_cache .mypy_cache .ruff_cache
