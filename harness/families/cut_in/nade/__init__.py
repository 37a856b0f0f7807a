"""Challenge of surrogates, importance functions made of it, and the likelihood ratios of what is drawn from them."""
