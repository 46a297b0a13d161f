"""What a mesh is, as data: configuration, descriptions, the validated system and its plan. No FMU, no Zenoh."""
