"""Score restoration methods on datasets: the verb ``score``."""
