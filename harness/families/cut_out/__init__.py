"""The vehicle ahead leaves the lane and reveals a slower one: the third family of UN R157."""
