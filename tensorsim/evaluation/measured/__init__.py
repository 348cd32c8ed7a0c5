"""How well networks trained only on simulated radar do on measured radar."""
