"""Commands of a checkout beside those of `dtsa_bench.commands`."""
