"""What a campaign is, and how it is read from YAML without surprises."""
