"""Where the key of authenticated frames comes from: the environment, so that it is in no bag and on no command line."""

from __future__ import annotations

import os

from dtsa_agent.core import AbstractSwarm, ConfigError
from dtsa_agent.core.authentication import AuthenticatedSwarm, Authenticator

VARIABLE = "DTSA_AUTH_KEY"


def with_key(swarm: AbstractSwarm) -> AbstractSwarm:
    """The swarm, with its frames authenticated if its settings say so (``auth``).

    :param swarm: as it was made.
    :raises ConfigError: if there is no key, or none that is usable.
    """
    if swarm.config.auth:
        text = os.environ.get(VARIABLE, "")
        if not text:
            raise ConfigError(VARIABLE, text, "32 to 64 hexadecimal digits in the environment, because auth is on")
        return AuthenticatedSwarm(swarm, Authenticator.from_hex(text, swarm.config.auth_session))
    return swarm
