"""The episode loop: policy, world and controller, cell by cell and step by step."""
