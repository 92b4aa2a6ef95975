"""Examples of each command: they stand at the end of its help, and a test reads them as the command does."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "demo": (
        ("", "everything, into runs/demo-1, and the page in a browser"),
        ("--animation --no-open --out story", "with a moving picture; no browser"),
    ),
    "fly": (
        ("--out runs/a", "twelve agents, a process each, as in the paper"),
        ("--out runs/b --agents 18 --policy lease --loss 0.1 --processes 2", "lost frames, two processes"),
        ("--out runs/c --mode realtime --policy lease --respawn 1", "clocks of their own; the dead come back"),
        ("--out runs/e --mode realtime --policy lease --view --control", "in a browser, which may kill agents and jam"),
        ("--out runs/d --backend cflib --config swarm.yaml", "Crazyflies"),
    ),
    "agent": (
        ("--id 3 --interface eth0 --auth-session 41", "the third of twelve; the key is in DTSA_AUTH_KEY"),
        ("--id 1 --agents 4 --interface lo --no-seal --duration-s 10 --out runs/cf1", "ten seconds, with a bag"),
        ("--swarm swarm.yaml --id 3 --auth-session 40 --check", "before a flight: do all hear all"),
        ("--id 3 --air crazyradio --uri radio://0/80/2M --slot-ms 20 --auth-session 41", "by a Crazyradio 2.0"),
    ),
    "simulate": (
        ("--agents 18 --policy dtsa --loss 0.01", "one flight, its results as lines"),
        ("--moving 2 --policy lease --json", "the same as JSON"),
        ("--agents 12 --picture flight.png", "with a picture of the paths"),
    ),
    "sweep": (
        ("--list", "what comes with the package"),
        ("--preset paper-12,paper-18 --seeds 30", "the paper's experiments"),
        ("--preset loss --set slot_ms=20 --out runs/slow", "with a setting changed"),
        ("--file own.yaml --json", "a sweep of your own, its groups as JSON"),
        ("--preset loss --paper pdf", "with figures and tables for a paper"),
    ),
    "league": (
        ("cells", "what is flown, and the schemes that come with the package"),
        ("enter lease --sample 2", "two practice seeds of each cell, to try it out"),
        ("enter examples/dtsa_plugins --jobs 2", "the policy of a folder, all cells"),
        ("check runs/league-1/lease", "flies a sample of its flights again"),
        ("table runs/league-1/lease runs/league-1/tdma --out runs/table", "a page, figures, CSV and LaTeX"),
    ),
    "peer-lab": (
        ("beacons --agents 12 --seconds 20", "twelve vehicles that broadcast their states"),
        ("dtr --loss 0.1 --polls 10", "a token ring with lost frames, beside a ground station that polls"),
        ("my_app --source lib/more.c --include lib --out runs/lab", "an app of your own, with files"),
    ),
    "new-plugin": (("my-policy --out plugins/my-policy", "then as its README.md says"),),
    "replay": (
        ("runs/a", "in real time"),
        ("runs/a --rate 0.5 --start 2 --loop", "half as fast, from 2 s on, again and again"),
    ),
    "verify": (("runs/a", "one run"), ("runs/a runs/b --json", "several, as JSON")),
    "sniff": (
        ("--interface eth0 --auth-session 41 --out runs/sniffed", "twelve agents; until Ctrl-C"),
        ("--air crazyradio --uri radio://0/80/2M --slot-ms 20 --auth-session 41 --pcap air.pcap", "for Wireshark, too"),
    ),
    "merge": (
        ("runs/cf1 runs/cf2 runs/cf3", "three agents' bags"),
        ("runs/cf* --json", "all of them, as JSON"),
        ("runs/cf* --out flight_1", "kept as one bag, for report, export and verify"),
    ),
    "losses": (("runs/a --out hall.json", "for simulate, sweep and fly, as --losses hall.json"),),
    "recover": (("runs/a", "into runs/a/bag_recovered"),),
    "view": (
        ("--domain 7", "the swarm on a ROS domain"),
        ("--air udp --interface eth0 --auth-session 41", "agents on a network; the key is in DTSA_AUTH_KEY"),
    ),
    "report": (("runs/a", "one run"), ("runs/a runs/b --out compared.html", "two side by side")),
    "export": (
        ("runs/a", "all tables as Parquet"),
        ("runs/a --to csv --tables slots frames --out tables", "two of them as CSV"),
    ),
    "bridge": (
        ("--config swarm.yaml --check", "is everything there that a flight needs?"),
        ("--config swarm.yaml --backend sim", "simulated Crazyflies in place of real ones"),
    ),
    "fake-crazyflie": (("--count 12", "twelve vehicles for the official library"),),
    "fake-modem": (("--dir runs/modems --modem sik-64k --count 3", "three modems: runs/modems/modem1 and so on"),),
    "completion": (
        ("bash > ~/.dtsa-completion.bash", "then, in ~/.bashrc: . ~/.dtsa-completion.bash"),
        ("zsh > ~/.dtsa-completion.zsh", "then, in ~/.zshrc: . ~/.dtsa-completion.zsh"),
    ),
}


def epilog(command: str, program: str) -> str:
    """The examples of a command as its help shows them; empty if it has none.

    :param command: its name.
    :param program: what stands in front.
    """
    lines = [f"  {program} {command} {words}".rstrip() + f"\n      {text}" for words, text in EXAMPLES.get(command, ())]
    return "\n".join(["examples:", *lines]) if lines else ""
