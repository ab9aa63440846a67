"""What a user would write or take instead of dvax."""
