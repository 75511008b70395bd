class Curobo:
    def path(self,*a): return None
