"""Studies, peers and unseen tasks: what measures the product and is no part of it."""
