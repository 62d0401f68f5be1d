"""Runnable baselines of mapp_env: the paper's meta-agent and what it is compared with."""
