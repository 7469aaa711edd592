"""Parameters of all nodes: dataclasses, the ranges of their fields, and the YAML files that override them."""
