"""What the trainings share: options, driver, targets and losses."""
