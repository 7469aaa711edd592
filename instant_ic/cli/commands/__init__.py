"""One module a verb of `ic`, each with ``add_parser(subparsers)``."""
