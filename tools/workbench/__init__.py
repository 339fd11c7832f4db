"""The workbench: one process that serves pages about the fleet and its models to a browser."""
