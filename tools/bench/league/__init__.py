"""The league of clocks and speeds: true drives, the faults of their loggers, and what the cleaning makes of them."""
