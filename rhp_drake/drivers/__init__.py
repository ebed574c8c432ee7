"""What talks to hardware: each driver in a process of its own."""
