"""Work for other processes and machines: tasks for any executor, values by their digest, retries."""
