"""How good a policy is: what can be said of successes in a finite number of episodes."""
