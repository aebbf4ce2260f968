"""Search for controller parameters: spaces, searchers, staged scoring and the store of trials."""
