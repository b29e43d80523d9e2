"""The live page: a server for newest frames, and the page that shows them."""
