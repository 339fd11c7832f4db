"""Reports of commands: tables in the terminal, and one HTML page of tables and figures."""
