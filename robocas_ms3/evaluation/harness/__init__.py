"""Other people's harnesses: our episodes in their loops."""
