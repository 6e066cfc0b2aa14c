"""Comparing methods: grids of runs, statistics and reports over their records."""
