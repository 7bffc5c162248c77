"""What is in a log, for `lgvi info`."""

import json
from typing import Any

from ..logs import LogError, describe, find_free_flights, read
from .settings import Settings


def show_info(settings: Settings, plot: str | None, as_json: bool) -> None:
    """Print what is in a log, and draw it."""
    log = read(settings.logs[0], settings.reader, **settings.read)
    contents = describe(log)
    has_force = any(signal.quantity == "specific_force" for signal in log.signals.values())
    flights, reason = (), "no signal is known to be a specific force"
    if has_force:
        try:
            flights, reason = find_free_flights(log), ""
        except LogError as error:
            reason = error.words
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
    if reason:
        print(f"free flights: not looked for: {reason}")
    for flight in flights:
        times = f"{flight.begin:.3f} to {flight.end:.3f} s"
        print(f"free flight {flight.name}: {times}, {flight.words}")
    if not flights and not reason:
        print("free flights: none")
