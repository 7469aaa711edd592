"""Parameter schema shared by all nodes: dataclasses, their ranges, and the YAML files that override them."""
