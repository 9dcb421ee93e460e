"""The ego's surroundings outside the joint graph: people, closest approaches, hidden road."""
