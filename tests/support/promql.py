"""The names of metrics in expressions of Prometheus."""

import re

STANDARD = {"up", "process_resident_memory_bytes", "process_cpu_seconds_total", "process_start_time_seconds"}
"""Metrics that Prometheus and every process export."""
FUNCTIONS = {
    *(
        "changes",
        "count",
        "deriv",
        "histogram_quantile",
        "increase",
        "label_values",
        "max",
        "min",
        "rate",
        "sum",
        "topk",
        "bottomk",
        "vector",
    ),
    *("and", "by", "on", "unless", "or"),
}


def list_metrics(expression: str) -> set[str]:
    """Return the metrics in an expression, without functions, labels and their values."""
    plain = re.sub(r'"[^"]*"', "", expression)
    plain = re.sub(r"\{[^}]*\}|\[[^\]]*\]", "", plain)
    plain = re.sub(r"\b(by|on) \([^)]*\)", "", plain)
    return set(re.findall(r"\b[a-z_][a-z_0-9]*\b", plain)) - FUNCTIONS
