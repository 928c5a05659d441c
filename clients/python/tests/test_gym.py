"""`trabecula.gym`: the environments, with Gymnasium's checks and in use by agents."""

from __future__ import annotations

import numpy as np
import support

gym, checker = support.needs("gymnasium", "gymnasium.utils.env_checker")


def test_gymnasium_accepts_the_environment_and_an_episode_repeats() -> None:
    """Gymnasium accepts the environment, and episodes are reproducible."""
    coarse = {"volume.spacing_mm": 1.0, "drr.columns": 64, "drr.rows": 64}
    env = gym.make(
        "trabecula.gym:trabecula/CurvedDrilling-v0", overrides=coarse, ticks=100, render_mode="rgb_array"
    )
    checker.check_env(env.unwrapped)
    runs = []
    for _ in range(2):
        observation, info = env.reset(seed=5)
        distance, total = info["distance_mm"], 0.0
        for count in range(60):
            observation, reward, ended, cut, info = env.step(np.array([-0.2, 0.5], np.float32))
            total += reward
        assert not ended and not cut and info["removed_voxels"] > 0
        assert total <= distance - info["distance_mm"] + 1e-6 and info["distance_mm"] < distance - 5.0
        runs.append((observation.tolist(), total))
    assert runs[0] == runs[1], runs
    assert env.render().shape == (64, 64, 3)
    several = gym.make_vec(
        "trabecula.gym:trabecula/CurvedDrilling-v0", num_envs=3, vectorization_mode="sync", overrides=coarse
    )
    observations, _ = several.reset(seed=5)
    assert observations.shape == (3, 9) and len({tuple(row) for row in observations.tolist()}) == 3
    several.step(several.action_space.sample())


def test_a_skiving_episode_leaves_its_line_in_unequal_bone_and_is_held_by_a_pull() -> None:
    """Without tension, the burr leaves its line toward the soft side at 1:10 but not at 1:1; a pull the other
    way keeps it closer.
    """
    coarse = {"volume.spacing_mm": 1.0}
    env = gym.make("trabecula.gym:trabecula/Skiving-v0", overrides=coarse, ticks=100)
    checker.check_env(env.unwrapped)

    def episode(ratio: float, tension: float) -> tuple[float, float, float]:
        observation, info = env.reset(seed=1, options={"ratio": ratio})
        assert info["ratio"] == ratio and not observation[:2].any()
        total, worst = 0.0, 0.0
        for _ in range(200):
            observation, reward, ended, cut, info = env.step(np.array([tension, -0.5], np.float32))
            total, worst = total + reward, max(worst, info["off_line_mm"])
            if ended or cut:
                break
        assert ended and not info["lost"], (info, observation)
        return total, worst, float(observation[0])

    straight, beside, held = episode(1.0, 0.0), episode(10.0, 0.0), episode(10.0, 0.05)
    # Voxels of 1 mm: the hole that the burr cuts is wider than the burr by up to that.
    assert straight[1] < 0.5 and 13.0 < straight[0] <= 14.0, straight
    assert beside[2] < -1.5 and beside[0] < 0.0, beside
    assert held[2] > beside[2] + 0.1 and episode(10.0, 0.05) == held
    several = gym.make_vec(
        "trabecula.gym:trabecula/Skiving-v0", num_envs=2, vectorization_mode="sync", overrides=coarse
    )
    assert several.reset(seed=3)[0].shape == (2, 7)


def test_an_agent_of_x_rays_sees_the_target_where_the_c_arm_projects_it() -> None:
    """The target is at its projection in the frame, and the observation contains only the frame and machine
    measurements.
    """
    coarse = {"volume.spacing_mm": 1.0}
    env = gym.make("trabecula.gym:trabecula/XRaySteering-v0", overrides=coarse, ticks=100)
    checker.check_env(env.unwrapped)
    observation, info = env.reset(seed=5)
    assert observation["image"].shape == (96, 96, 1) and np.ptp(observation["image"]) > 50
    camera = env.unwrapped.sim.render().frame.projection
    k, r = np.array(camera.intrinsics).reshape(3, 3), np.array(camera.rotation).reshape(3, 3)
    seen = k @ (r @ (np.array(info["target_mm"]) * 1e-3) + np.array(camera.translation_m))
    expected = seen[:2] / seen[2] / 96.0
    assert np.allclose(observation["target"], expected, atol=1e-5), (observation["target"], expected)
    first = observation["image"].copy()
    for _ in range(20):
        observation, _, _, _, info = env.step(np.array([-0.2, 0.5], np.float32))
    assert (observation["image"] != first).any() and observation["measured"][0] > 2.0, observation["measured"]
