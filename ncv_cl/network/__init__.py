"""The network: its inputs encoded, its parameters, its weights at each point."""
