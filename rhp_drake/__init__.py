"""Receding-horizon planning with a learned value function, in Drake."""
