"""Many recordings: on one machine or on a cluster, each once, and a table of all."""
