"""One module per verb of `ic`, each with ``add_parser(subparsers)``."""
