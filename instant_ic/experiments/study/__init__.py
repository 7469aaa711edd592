"""``ic study``: a blind, counterbalanced user study (the paper's V.E with people) in the operator's page."""
