"""Choice of the model: nested variants of ``[model]`` side by side, judged by how well they predict a setting left out."""
