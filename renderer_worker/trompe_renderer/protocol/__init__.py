"""SAILenv's socket protocol: connections, the state of each agent, uploads."""
