"""The decision process of a team: observations, global state, rewards, failures and initial states."""
