"""Evaluations and the paper's experiments: worlds, operators, baselines and figures."""
