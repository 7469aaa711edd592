"""One schema of parameters for all nodes: dataclasses, their ranges, and the YAML files that override them."""
