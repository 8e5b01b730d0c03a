"""Policy search by the algorithms of Stable-Baselines3, which needs torch."""
