"""Types of the public names of `dtsa`, which are loaded when they are first used."""

from dtsa_agent.core import Agent as Agent
from dtsa_agent.core import ConfigError as ConfigError
from dtsa_agent.core import Decision as Decision
from dtsa_agent.core import DtsaError as DtsaError
from dtsa_agent.core import LocalProtocolError as LocalProtocolError
from dtsa_agent.core import PluginError as PluginError
from dtsa_agent.core import RemoteProtocolError as RemoteProtocolError
from dtsa_agent.core import SlotOutcome as SlotOutcome
from dtsa_agent.core import SwarmConfig as SwarmConfig
from dtsa_agent.core import plug_in_random as plug_in_random
from dtsa_agent.core.plugins import Table as Table
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench import __version__ as __version__
from dtsa_bench.drawing.palette import agent_colour as agent_colour
from dtsa_bench.log.bag.errors import BagError as BagError
from dtsa_bench.log.bag.errors import UnusableBag as UnusableBag
from dtsa_bench.log.flight_log import FlightLog as FlightLog
from dtsa_bench.log.verify.result import Difference as Difference
from dtsa_bench.log.verify.result import Result
from dtsa_bench.runs.config import RunConfig as RunConfig
from dtsa_bench.runs.config import RunLimits as RunLimits
from dtsa_channel_sim import Channel as Channel
from dtsa_channel_sim import ChannelConfig as ChannelConfig
from dtsa_channel_sim import ClockConfig as ClockConfig
from dtsa_channel_sim import Verdict as Verdict

from . import env as env
from ._flights import open as open
from ._flights import register as register
from ._flights import run_config as run_config
from ._flights import simulate as simulate
from ._flights import verify as verify
from ._plots import plot_ages as plot_ages
from ._plots import plot_bars as plot_bars
from ._plots import plot_distances as plot_distances
from ._plots import plot_lines as plot_lines
from ._plots import plot_matrix as plot_matrix
from ._plots import plot_trajectories as plot_trajectories
from ._sweep import SweepResult as SweepResult
from ._sweep import sweep as sweep

REASONS = REASON_TEXTS
Verification = Result
