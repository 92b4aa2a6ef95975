"""Where the key of authenticated frames comes from: the environment, so that it is in no bag and on no command line."""

from __future__ import annotations

import os

from dtsa_agent.core.authentication import Authenticator

from .core import ConfigError, Swarm, SwarmConfig

VARIABLE = "DTSA_AUTH_KEY"


def with_key(swarm: Swarm) -> Swarm:
    """The swarm, with its frames authenticated if its settings say so (``auth``).

    :raises ConfigError: if there is no key, or none that is usable.
    """
    swarm.authenticator = authenticator(swarm.config)
    return swarm


def check_key(config: SwarmConfig) -> None:
    """Looks whether there is a usable key where the settings ask for one, before anything is started or written.

    :raises ConfigError: if there is none.
    """
    authenticator(config)


def check_session(config: SwarmConfig) -> None:
    """Whether sealed frames say which flight they are of, where no channel's node draws that.

    :raises ConfigError: if they do not: frames of earlier flights, played again, would count as genuine.
    """
    if config.auth and not config.auth_session:
        allowed = "1 to 2^63 - 1, another one for each flight and the same on all computers; or frames without a seal"
        raise ConfigError("auth_session", config.auth_session, allowed)


def authenticator(config: SwarmConfig) -> Authenticator | None:
    """What seals and opens the frames of a swarm; None if its settings do not ask for that.

    :raises ConfigError: if there is no key, or none that is usable.
    """
    if not config.auth:
        return None
    text = os.environ.get(VARIABLE, "")
    if not text:
        raise ConfigError(VARIABLE, text, "32 to 64 hexadecimal digits in the environment, because auth is on")
    return Authenticator.from_hex(text, config.auth_session)
