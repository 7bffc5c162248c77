"""What is in a log, for `lgvi info`."""

import json
from typing import Any

from ..logs import describe, find_free_flights, read
from .settings import Settings


def show_info(settings: Settings, plot: str | None, as_json: bool) -> None:
    """Print what is in a log, and draw it."""
    log = read(settings.logs[0], settings.reader, **settings.read)
    contents = describe(log)
    has_force = any(signal.quantity == "specific_force" for signal in log.signals.values())
    flights = find_free_flights(log) if has_force else ()
    if plot is not None:
        from ..plotting.log import plot_log

        plot_log(log, flights).savefig(plot)
    if as_json:
        result: dict[str, Any] = {
            "path": log.path,
            "kind": log.kind,
            "start": None if log.start is None else log.start.isoformat(),
            "facts": dict(log.facts),
            "assumed": list(log.assumed),
            "contents": contents.as_dict(),
            "flights": [[flight.name, flight.begin, flight.end] for flight in flights],
        }
        print(json.dumps(result, indent=2, ensure_ascii=False))
        return
    print(contents)
    shown = {key: value for key, value in log.facts.items() if not key.startswith("PARM")}
    for key, value in list(shown.items())[:20]:
        print(f"{key}: {value}")
    if not has_force:
        print("free flights: not looked for, as no signal is known to be a specific force")
    for flight in flights:
        print(f"free flight {flight.name}: {flight.begin:.3f} to {flight.end:.3f} s")
    if has_force and not flights:
        print("free flights: none")
