"""Evaluate expressions of Prometheus on samples: the operators that alert rules and the guide use.

A rate or an increase is the value of the sample itself. Vectors match one to one, as in Prometheus.
"""

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple


class Sample(NamedTuple):
    """A value with its labels, among them `__name__`."""

    labels: dict[str, str]
    value: float


Vector = list[Sample]
_TOKEN = re.compile(r'\s*("[^"]*"|\[[^\]]*\]|[0-9.]+(?:e[0-9]+)?|[A-Za-z_]\w*|==|!=|=~|[<>]=|[-(){},=<>*/+])')
_LEVELS = ({"or"}, {"and", "unless"}, {"==", "!=", "<", ">", "<=", ">="}, {"+", "-"}, {"*", "/"})
_PAIRS: dict[str, Callable[[float, float], Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
}
_SUMMARIES: dict[str, Callable[[list[float]], float]] = {"sum": sum, "max": max, "min": min, "count": len}


def evaluate(expression: str, samples: Sequence[Sample]) -> dict[tuple[tuple[str, str], ...], float]:
    """Return the values of an expression by their labels, sorted and without the metric's name."""
    parser = _Parser(expression, samples)
    found = parser.read(0)
    assert not parser.left, f"not understood: {parser.left}"
    return {_key(sample.labels, None): sample.value for sample in found}


class _Parser:
    """Read an expression from its left, and evaluate it."""

    def __init__(self, expression: str, samples: Sequence[Sample]) -> None:
        self.left, self._samples = _TOKEN.findall(expression), samples
        assert "".join(self.left) == re.sub(r"\s", "", expression), expression

    def read(self, level: int) -> Any:
        """Return the value of operators of a level and of those that bind tighter."""
        if level == len(_LEVELS):
            return self._read_operand()
        value = self.read(level + 1)
        while self.left and self.left[0] in _LEVELS[level]:
            sign = self.left.pop(0)
            on = self._read_labels() if self._takes("on") else None
            value = _combine(sign, value, self.read(level + 1), on)
        return value

    def _takes(self, token: str) -> bool:
        """Return whether a token comes next, and take it."""
        is_next = bool(self.left) and self.left[0] == token
        if is_next:
            self.left.pop(0)
        return is_next

    def _read_labels(self) -> list[str]:
        """Return the names in brackets."""
        end = self.left.index(")")
        names, self.left = [name for name in self.left[1:end] if name != ","], self.left[end + 1 :]
        return names

    def _read_operand(self) -> Any:
        """Return the value of a number, a bracket, a function or a metric."""
        token = self.left.pop(0)
        if token[0].isdigit():
            return float(token)
        if token != "(" and self.left and self.left[0] in {"(", "by"}:
            by = self._read_labels() if self._takes("by") else []
            self.left.pop(0)
            return _apply(token, by, self._read_bracket())
        return self._read_bracket() if token == "(" else self._select(token)

    def _read_bracket(self) -> Any:
        """Return the value of what stands before the closing bracket."""
        value = self.read(0)
        assert self._takes(")")
        return value

    def _select(self, name: str) -> Vector:
        """Return the samples of a metric that its matchers in braces admit."""
        found = [sample for sample in self._samples if sample.labels["__name__"] == name]
        if self._takes("{"):
            while not self._takes("}"):
                label, sign, text = self.left.pop(0), self.left.pop(0), self.left.pop(0).strip('"')
                pattern = text if sign == "=~" else re.escape(text)
                keeps = sign != "!="
                found = [s for s in found if bool(re.fullmatch(pattern, s.labels.get(label, ""))) == keeps]
                self._takes(",")
        if self.left and self.left[0].startswith("["):
            self.left.pop(0)
        return found


def _key(labels: Mapping[str, str], on: Sequence[str] | None) -> tuple[tuple[str, str], ...]:
    """Return the labels by which samples match, without the metric's name."""
    return tuple(sorted((n, v) for n, v in labels.items() if n != "__name__" and (on is None or n in on)))


def _apply(function: str, by: Sequence[str], value: Any) -> Vector:
    """Return the result of a function or an aggregation."""
    if function == "vector":
        return [Sample({}, value)]
    if function in {"rate", "increase"}:
        return [Sample({n: v for n, v in s.labels.items() if n != "__name__"}, s.value) for s in value]
    groups: dict[tuple[tuple[str, str], ...], list[float]] = {}
    for sample in value:
        groups.setdefault(_key(sample.labels, by), []).append(sample.value)
    return [Sample(dict(key), float(_SUMMARIES[function](values))) for key, values in groups.items()]


def _combine(sign: str, left: Any, right: Any, on: Sequence[str] | None) -> Any:
    """Return the result of an operator between vectors, or a vector and a number."""
    if sign in {"and", "unless", "or"}:
        there = {_key(s.labels, on) for s in (left if sign == "or" else right)}
        if sign == "or":
            return left + [s for s in right if _key(s.labels, on) not in there]
        return [s for s in left if (_key(s.labels, on) in there) == (sign == "and")]
    if isinstance(left, float):
        return [Sample(s.labels, float(_PAIRS[sign](left, s.value))) for s in right]
    if isinstance(right, float):
        pairs = [(sample, sample.labels, right) for sample in left]
    else:
        others = {_key(s.labels, on): s.value for s in right}
        assert len(others) == len(right), "several samples match on the right"
        keyed = [(sample, _key(sample.labels, on)) for sample in left]
        pairs = [(sample, dict(key), others[key]) for sample, key in keyed if key in others]
    if sign in _LEVELS[2]:
        return [sample for sample, _, other in pairs if _PAIRS[sign](sample.value, other)]
    return [Sample(labels, float(_PAIRS[sign](sample.value, other))) for sample, labels, other in pairs]
