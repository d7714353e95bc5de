"""The paper's experiment, reproduced in three parts: the world, the choices, the prediction."""
