"""Small environments for `ppo`."""

import torch


class LeftOrRight:
    """Env that rewards actions with the sign of the observation, in short episodes."""

    STEPS = 4

    def __init__(self, count):
        self.count, self.seeds, self.draws = count, [], torch.Generator()

    def reset(self, seed):
        self.seeds.append(seed)
        self.draws.manual_seed(seed)
        self.step_number, self.returns = 0, torch.zeros(self.count)
        return self._observe(), {}

    def step(self, action):
        reward = (self.obs * action)[:, 0].clamp(-1, 1)
        self.step_number, self.returns = self.step_number + 1, self.returns + reward
        is_last = self.step_number == self.STEPS
        truncated = torch.full((self.count,), is_last)
        obs, info = self._observe(), {}
        if is_last:
            final = {
                "episode": {"return": self.returns},
                "reward_terms": {"grasp": (self.returns > 2).float()},
                "target_lifted": self.returns > 3,
                "success": self.returns > 3.9,
            }
            info = {"final_obs": obs, "final_info": final, "_final_info": truncated}
            self.step_number, self.returns = 0, torch.zeros(self.count)
        return obs, reward, torch.zeros_like(truncated), truncated, info

    def close(self):
        pass

    def _observe(self):
        self.obs = torch.randint(0, 2, (self.count, 1), generator=self.draws) * 2.0 - 1
        return self.obs


class StubEnvironments:
    name, hash, facts = "left or right", "1234", {"observation_size": 1, "action_size": 1, "rate_hz": 5}  # noqa: RUF012
    made = []  # noqa: RUF012

    def __init__(self, config, device):
        self.config, self.episodes = config, config.layouts
        self.envs = self.make_envs(config.envs, 0, config.layouts - 1)
        self.made.append(self.envs)

    def __len__(self):
        return self.config.train.steps

    def make_envs(self, count, first_seed, last_seed):
        return LeftOrRight(count)

    def close(self):
        pass
