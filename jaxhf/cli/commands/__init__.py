"""What each command does: `run`, in a file that is imported when it is asked for."""
