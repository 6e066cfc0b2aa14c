"""What comes out: numbers, rollouts, callbacks and pictures of Pareto fronts."""
