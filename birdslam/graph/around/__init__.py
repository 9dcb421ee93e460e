"""Those around the ego beside the joint graph: people, closest approaches, the road that is hidden."""
