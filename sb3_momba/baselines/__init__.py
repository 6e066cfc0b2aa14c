"""Other methods, under the protocol and in the records of ours: PGMORL, GPI-LS, DPMORL; `python -m sb3_momba.baselines`."""
