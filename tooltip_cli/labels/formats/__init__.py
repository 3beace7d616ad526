"""Labels as other tools keep them, one file a tool; see :mod:`tooltip_cli.labels.exchange`."""
