"""How far networks that saw simulated radar only go on measured radar."""
