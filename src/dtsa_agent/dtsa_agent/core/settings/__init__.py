"""What a swarm is told: settings that describe themselves, the parts they name, and who starts where."""
