"""A virtual lab: stand-ins for the machines of a real one, on loopback."""
