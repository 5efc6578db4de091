"""Plans by weights that can be learned, and derivatives of plans and flights by them."""
