"""Numbers as text; the templates use them as filters."""

from __future__ import annotations

from datetime import datetime, timezone

from vlagents_ray.evaluate.results.statistics import Rate

NONE, MINUS = "\u2013", "\u2212"


def percent(rate: Rate) -> str:
    """The rate in per cent, with one decimal."""
    return NONE if rate.rate is None else f"{100 * rate.rate:.1f}"


def interval(rate: Rate) -> str:
    """The interval of the rate, in per cent."""
    if rate.rate is None:
        return NONE
    low, high = rate.interval
    return f"{100 * low:.1f} to {100 * high:.1f}"


def interval_name(rate: Rate) -> str:
    """The kind of that interval: a confidence sequence where cells could stop early, else Wilson's."""
    if rate.error_rate is None:
        return "95 % Wilson interval"
    return f"{100 * (1 - rate.error_rate):g} % confidence sequence"


def points(difference: float | None) -> str:
    """A difference of rates, in percentage points, with its sign."""
    if difference is None:
        return NONE
    text = f"{100 * difference:+.1f}".replace("-", MINUS)
    return "0.0" if float(f"{100 * difference:.1f}") == 0 else text


def p_value(p: float) -> str:
    """A p-value with its significant digits; never 0."""
    if p < 1e-4:
        return "< 0.0001"
    return f"{p:.4f}" if p < 0.01 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def number(value: float | None, digits: int = 1) -> str:
    """A number with thin spaces between thousands; a dash for None."""
    return NONE if value is None else f"{value:,.{digits}f}".replace(",", "\u202f")


def quantity(n: int, thing: str) -> str:
    """A number of things: "1 episode", "2 episodes"."""
    return f"{number(n, 0)} {thing}" if n == 1 else f"{number(n, 0)} {thing}s"


def duration(seconds: float) -> str:
    """A duration in at most two units: "1 h 12 min"."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def moment(seconds: float) -> str:
    """A time in seconds since 1970, to the minute, in UTC."""
    return datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
