"""What training, export and runtime must agree on: frames, lanes, scenes, contract. numpy only."""
