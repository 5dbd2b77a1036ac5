"""The application: the command `lieint`, scenarios, studies and their pictures. The library below never imports it."""
