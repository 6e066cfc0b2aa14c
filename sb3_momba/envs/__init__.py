"""What the agent acts in: preferences, the wrapper that shows them to the agent, and tasks."""
