"""A scripted policy in the environment for learning: each agent sends in its own turn. It needs PettingZoo."""

import dtsa
from dtsa.env import fields, parallel_env

SETTINGS = {"agents": 12, "moving": 4, "loss": 0.1}

env = parallel_env(**SETTINGS)
observations, infos = env.reset(seed=7)
worth = 0.0
while env.agents:
    turns = {agent: fields(seen, agents=12)["turn_in"] for agent, seen in observations.items()}
    actions = {agent: int(turn == 0) for agent, turn in turns.items()}
    observations, rewards, terminated, truncated, infos = env.step(actions)
    worth += rewards["agent_1"]

summary = infos["agent_1"]["summary"]
flown = dtsa.simulate(policy="tdma", seed=7, **SETTINGS).summary
print(f"{summary['end']} after {summary['slots']['total']} slots; the sum of rewards is {worth:.1f}")
print(f"age from waking on: {summary['waking_age_mean_slots']:.3f} slots, of policy tdma in `simulate`: ", end="")
print(f"{flown['waking_age_mean_slots']:.3f}")
