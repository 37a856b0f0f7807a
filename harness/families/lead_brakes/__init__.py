"""The vehicle ahead brakes: the second family of UN R157."""
