"""Evaluations and the paper's experiments: their worlds, operators, baselines and figures."""
