"""Evaluation that others can reproduce: protocols, policies, rollouts, measures, statistics."""
