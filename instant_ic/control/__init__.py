"""Illusory control: prediction, costmap, arbiter, subgoal, planner, follower, v-bot, safety (arrays in, arrays out)."""
