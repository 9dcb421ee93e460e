"""Commands on a vehicle's computer, and over many vehicles."""
