"""Virtual experiments: layers and samples made by formulas, and OCT of them."""
