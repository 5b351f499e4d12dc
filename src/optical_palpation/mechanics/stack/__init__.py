"""Two bodies: a layer on a deformable sample, between the window and a plate."""
