"""Shape, pose and soft tissue of people from markers alone [MoSh]."""
