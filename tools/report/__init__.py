"""The report of an evaluation: tables in the terminal, and one page of tables and figures."""
