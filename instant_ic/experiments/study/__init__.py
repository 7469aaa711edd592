"""A blind user study as in the paper's section V.E: plan, drives, pages and table."""
