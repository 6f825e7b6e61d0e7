"""The network: its inputs encoded, its parameters, and its weights at each point."""
