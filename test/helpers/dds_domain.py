"""DDS domains that nobody else on this machine uses, so that what runs side by side does not meet."""

from __future__ import annotations

import random
import socket
from collections import deque

DOMAINS = range(1, 101)  # the ports of a higher one are among those that Linux gives to clients
PARTICIPANTS = 20  # of a domain, that are looked for
LAST_PARTICIPANT = 119  # that a domain has ports for
KEPT = 8
_reservations: deque[socket.socket] = deque()


def random_domain() -> int:
    """A domain without participants.

    It is kept free from others like us until `KEPT` more are asked for: by then it has participants or is done with.
    """
    domain, reservation = reserved_domain()
    _reservations.append(reservation)
    if len(_reservations) > KEPT:
        _reservations.popleft().close()
    return domain


def reserved_domain() -> tuple[int, socket.socket]:
    """A domain without participants, and what keeps it free from others like us until it is closed.

    Raises:
        RuntimeError: all are in use.
    """
    for domain in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
        try:
            reservation = bound(port(domain, LAST_PARTICIPANT))
        except OSError:
            continue
        try:
            for participant in range(PARTICIPANTS):
                bound(port(domain, participant)).close()
        except OSError:
            reservation.close()
            continue
        return domain, reservation
    raise RuntimeError(f"all DDS domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use on this machine")


def port(domain: int, participant: int) -> int:
    """UDP port that a participant listens to (RTPS 2.5, 9.6.2.3: metatraffic, unicast)."""
    return 7400 + 250 * domain + 10 + 2 * participant


def bound(number: int) -> socket.socket:
    """A socket with this UDP port; OSError if somebody has it."""
    result = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        result.bind(("", number))
    except OSError:
        result.close()
        raise
    return result
