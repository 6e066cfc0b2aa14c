"""What files, checkpoints and resumption promise, put to the test: `python -m tests.torture [PART ...] [--counts short]`.

Every part prints one table, with Stable-Baselines3 beside it where it has the like, and each promise that did not hold. The
exit status is 1 if there is one. For Linux: processes are forked, killed and limited.

- kill: a training that is killed at random moments, and goes on from what is left, again and again
- operations: a kill before and after every file operation of one checkpoint
- resume: trainings that go on from a checkpoint against those that never stopped
- mutate: damaged and malicious files
- disk: a disk that is full at any byte
- million: what a checkpoint costs with a million transitions in the replay buffer (`--counts long` only)
- guards: what all checks of a training's numbers cost of its step rate
"""
