"""How long things take, on a stated machine: `make bench` runs `python -m tests.benchmarks`; no test collects it."""
