"""The rules and what runs them, over arrays: no PettingZoo, no Gymnasium."""
